"""Blocks of bytes in image files: boxes, segments, tags and packets."""
