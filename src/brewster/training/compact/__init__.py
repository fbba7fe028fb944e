"""Training and ONNX export of the compact network."""
