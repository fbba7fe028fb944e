"""Training data: mixtures of photos, rendered samples, real pairs, and streams that interleave
them.
"""
