"""What stands before the camera: plain frozen data, printed and read as TOML; no renderer."""
