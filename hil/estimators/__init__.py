"""Estimators: robot models from data. They see datasets and dynamics, never a robot or a file.

Nothing heavy is imported before an estimator is asked for by name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
