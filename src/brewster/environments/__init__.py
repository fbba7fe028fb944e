"""Environment maps and pictures of scenes, from files or procedurally generated."""
