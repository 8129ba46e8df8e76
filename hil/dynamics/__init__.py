"""Rigid-body models, regressors, base parameters, friction columns and collision distances.

Importing this package loads no large library; Pinocchio is imported with the first name of the
package that needs it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
