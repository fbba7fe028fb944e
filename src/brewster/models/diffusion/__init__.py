"""Large image-editing diffusion models that separate photos by generating I, T and R as panels of one image.

    backbones     the table of models: load one from the hub or a folder, or build a tiny version
    families/     one Backbone class per model backbone_class: kontext, klein, qwen
    panels        composes I, T and R into one image, and splits it again
    memory        checks device, memory and disk before a download
    prompt        the paper's prompt, encoded once
    text_encoders where the text encoders are loaded
    task          which panels to generate, their size, and the sampling method
    sampling      generates panels from noise, step by step as the pipelines of diffusers do
    pipeline      a backbone with its LoRA and prompt: photo in, panels out
    adapter/      LoRA files that diffusers can load, and their upload to the hub
    tensors       safetensors files with metadata
    lazy_imports  imports diffusers, transformers and peft at their first use

Importing this package imports torch, but none of the other libraries.
"""
