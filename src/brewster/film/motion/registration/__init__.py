"""Registers frames before anything is optimised: the motions of both layers, from features and from
spectra."""
