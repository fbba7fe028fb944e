"""Renders a scene into five linear images, and simulates the photograph that a camera would take of them."""
