"""Measures the two layers of several frames of one window by their motions, which differ."""
