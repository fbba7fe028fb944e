"""Large image-editing diffusion models that separate photos by generating I, T and R as panels of one image.

    model_source  what a value of --model is: a backbone from backbones/, or a LoRA from adapter/ with its base
    pipeline      a backbone with its LoRA and prompt: photo in, panels out
    memory        checks device, memory and disk before a download, and has the table of sizes

All functions raise errors of brewster only: ModelError (a name is unknown, or a file is missing, damaged or of another
model), DownloadError, DeviceError (no such device, or too little memory), MissingExtra and OutputError. `task` and
`hub_download` need no torch; no module imports diffusers, transformers or peft before its first use.
"""
