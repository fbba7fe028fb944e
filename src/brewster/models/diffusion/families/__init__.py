"""What differs between backbones: FLUX.1 Kontext, FLUX.2 klein, Qwen-Image-Edit; `family` is what they share."""
