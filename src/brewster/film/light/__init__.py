"""Measures the two layers of several photos of a camera that stood by the change of the light."""
