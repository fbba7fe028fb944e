"""Environment maps and pictures of scenes, which are read from files or procedurally generated."""
