"""Rendered sets: the store of samples on disk, and their generation with several processes."""
