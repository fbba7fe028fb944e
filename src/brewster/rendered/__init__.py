"""Rendered samples on disk: the store that reads and writes them, and their generation by many processes."""
