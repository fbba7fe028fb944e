"""What do we keep? Sets of samples, readers of other people's sets, and streams to learn from."""
