"""Errors per joint, trajectory and load, and the verdict against a spec's criteria."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
