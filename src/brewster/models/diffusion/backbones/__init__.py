"""The model families: FLUX.1 Kontext, FLUX.2 klein and Qwen-Image-Edit. `family` has their base classes."""
