"""Networks: Levenberg–Marquardt MLPs, Lagrangian networks, residual networks and their training.

All networks are estimators with the interface of `hil.estimators`. Only the modules that compute
with torch import torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
