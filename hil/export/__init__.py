"""Fitted models for other programs: C for controllers, ONNX, parameters as JSON."""
