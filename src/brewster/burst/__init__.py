"""Several photos of one window: the layers move differently, so that they can be measured instead of guessed."""
