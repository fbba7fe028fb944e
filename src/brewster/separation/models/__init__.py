"""The models that separate a photo: the compact network, diffusion models, and the table of shipped
models.
"""
