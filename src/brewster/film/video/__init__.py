"""Reads the frames and the sound of films, chooses frames, and writes films."""
