"""The model of a burst, two moving layers whose sum is each frame, and its optimisation."""
