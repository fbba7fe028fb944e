"""How does it learn? A recipe, losses, one loop, and what it leaves behind."""
