"""Colour spaces of photos, and how files describe them."""
