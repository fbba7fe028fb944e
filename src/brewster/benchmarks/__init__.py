"""The field's benchmarks: which there are, how their folders are laid out, and how their files are paired by name."""
