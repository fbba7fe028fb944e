"""How does a LoRA on a large backbone learn, what will that cost, and what does its card say?"""
