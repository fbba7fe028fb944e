"""Environments computed from a seed, for machines without HDR maps: streets, rooms, nights and paintings."""
