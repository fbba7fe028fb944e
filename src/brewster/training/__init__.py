"""Training: recipes, data streams, losses, one loop, checkpoints, and the trainers of both kinds of
model.
"""
