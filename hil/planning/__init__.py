"""From spec, station and excitation to an immutable plan.

`hil.plan(experiment)` makes one; `hil.planning.plan` holds the data.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
