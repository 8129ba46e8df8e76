"""Fitted models for other programs: C for controllers, ONNX, parameters as JSON."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
