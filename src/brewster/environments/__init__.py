"""What lights a scene: files in folders, told apart by name and sha256, and worlds that are computed."""
