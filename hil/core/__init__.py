"""Foundations of all packages: errors, plug-ins, files, locks, YAML with positions, units."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
