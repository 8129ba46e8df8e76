"""Estimators that fit robot models to datasets, without access to robots or recording files.

Modules of estimators are imported lazily, when an estimator is requested by its name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
