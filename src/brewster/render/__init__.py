"""Renders the five linear images of a scene, and simulates the camera that turns them into
photographs.
"""
