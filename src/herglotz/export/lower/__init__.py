"""The translation of traced functions to each format: C, ONNX, `.pt2` and AOTInductor."""
