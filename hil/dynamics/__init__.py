"""Rigid-body models, regressors, base parameters, friction columns and collision distances.

Importing this package loads nothing heavy; Pinocchio comes with the first name that needs it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
