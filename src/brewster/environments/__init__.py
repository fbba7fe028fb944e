"""Environment maps and pictures of scenes: files in folders, identified by name and sha256, and procedural ones."""
