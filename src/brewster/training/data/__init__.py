"""Training data: mixtures made online, rendered samples, real pairs, and the streams that interleave them."""
