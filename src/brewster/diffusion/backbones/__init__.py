"""The backbones FLUX.1 Kontext, FLUX.2 klein and Qwen-Image-Edit. `backbone` has their base
classes.
"""
