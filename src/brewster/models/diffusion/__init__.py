"""Which large image models can learn in-context separation, and how do they see pictures?

    backbones   the table of models: load a real one, or build a tiny twin
    families/   what differs between them: kontext, klein, qwen
    panels      I, T and R in one picture, and out again
    prompt      the paper's prompt, encoded once
    task        which panels to make, how large, and by which way
    sampling    from noise to panels, as the stock pipelines do it
    decompose   a photo in, its layers out
    adapter/    what training adds, in a folder that stock diffusers loads: lora, and the hub

No training and no command line here. diffusers, transformers and peft are imported in this room only, through
`stock`, and only when a model is built: importing the room costs nothing but torch.
"""
