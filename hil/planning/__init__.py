"""Planning: compute an immutable plan from spec, station and excitation.

The function `hil.plan(experiment)` computes a plan, whose data are defined in `hil.planning.plan`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
