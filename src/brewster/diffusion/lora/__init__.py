"""Training of a LoRA on a diffusion backbone, its resource estimate and its model card."""
