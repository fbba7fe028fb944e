"""Large image-editing diffusion models that separate photos by generating I, T and R as panels of
one image.

Functions raise errors of brewster only: ModelError (an unknown name; a missing, damaged or other
file), DownloadError, DeviceError, MissingExtra and OutputError. `task` and `hub_download` need no
torch; no module imports diffusers, transformers or peft before its first use.
"""
