"""What training leaves of a large model, and what is read, sent and fetched: the folder of a LoRA."""
