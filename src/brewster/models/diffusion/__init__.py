"""Large image-editing diffusion models that separate photos by generating I, T and R as panels of one image.

    backbones/    one Backbone class for each model (kontext, klein, qwen), their table, and how they are loaded
    model_source  finds out what a value of --model is: a backbone, or a LoRA with its base
    panels        composes I, T and R into one image, and splits it again
    memory        checks device, memory and disk before a download (../diffusion_resources.py has the tables and formulas)
    offloading    weights in host memory, and decoding in tiles, for small GPUs; out-of-memory errors
    prompt        the paper's prompt, encoded once
    task          which panels to generate, their size, and the sampling method
    sampling      generates panels from noise, step by step as the pipelines of diffusers do
    pipeline      a backbone with its LoRA and prompt: photo in, panels out
    adapter/      LoRA files that diffusers can load, and their upload to the hub
    gensirr       converts the checkpoint of GenSIRR
    hub_download  finds files of the hub in the cache, or downloads them
    tensors       safetensors files with metadata, and JSON files
    lazy_imports  imports diffusers, transformers and peft at their first use

`panels`, `task` and `hub_download` need no torch; no module imports the other libraries before their first use.
"""
