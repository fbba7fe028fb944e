"""Which large image models can learn in-context separation, and how do they see pictures?

    panels      I, T and R in one picture, and out again
    prompt      the paper's prompt, encoded once
    backbones   the table of models: load a real one, or build a tiny twin (kontext, klein, qwen)
    sampling    from noise to panels, as the stock pipelines do it
    lora        what the training adds, in a file that stock diffusers loads

No training and no command line here. diffusers, transformers and peft are imported in this room only, and
only when a model is built: importing the room costs nothing but torch.
"""
