"""Public benchmarks of reflection removal: the registry of their folder layouts, and the pairing of
files by name.
"""
