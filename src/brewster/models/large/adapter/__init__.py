"""What training leaves of a large model, and what is read, sent and fetched: the LoRA and its encoded prompt, in a folder."""
