"""Uses of a fitted model: rest poses, hand guiding, collision detection, and control trials.

The modules of this folder use models, data and dynamics; the caller passes the surroundings of a
robot if needed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
