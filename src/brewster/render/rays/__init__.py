"""What rays meet: stacks of glass, rough surfaces, light all around, and chance."""
