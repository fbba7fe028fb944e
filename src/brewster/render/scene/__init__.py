"""Scenes and scene recipes: frozen data that is read from and written to TOML. This package has no
renderer.
"""
