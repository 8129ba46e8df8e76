"""Workflows from a spec to an evaluated model: run, fit, evaluate and report."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
