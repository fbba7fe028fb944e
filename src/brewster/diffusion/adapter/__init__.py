"""The folder of a LoRA: writing and reading it, and uploading it to the hub."""
