"""Public benchmarks of reflection removal: a registry of their folder layouts, and the pairing of files by name."""
