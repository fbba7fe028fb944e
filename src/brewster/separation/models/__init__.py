"""The models that separate a photo: the compact network, and the table of model files."""
