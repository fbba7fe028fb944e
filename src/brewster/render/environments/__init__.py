"""Environment maps and pictures of scenes, which are files of the user or part of brewster."""
