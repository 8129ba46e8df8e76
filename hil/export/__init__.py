"""Export of fitted models for other programs: C for controllers, ONNX, PyTorch, URDF and JSON."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
