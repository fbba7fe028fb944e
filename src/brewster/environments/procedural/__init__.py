"""Environments computed from a seed, for machines without HDR maps: streets by day or night, rooms and paintings."""
