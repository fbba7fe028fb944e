"""Scenes and scene recipes: frozen data, read from and written as TOML. No renderer."""
