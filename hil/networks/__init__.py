"""Networks: Levenberg-Marquardt MLPs, Lagrangian networks, residual networks and their training.

They are estimators as those of `hil.estimators`; torch is imported in the modules that compute
with it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
