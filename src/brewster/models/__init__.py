"""The models that separate a photo: the compact network, large diffusion models, and the table of shipped models."""
