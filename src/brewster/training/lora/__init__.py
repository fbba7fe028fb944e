"""Training of a LoRA on a large backbone, its resource estimate and its model card."""
