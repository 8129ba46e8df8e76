"""Uses of a fitted model: where an arm rests best, and how it follows a hand.

They see models, data and dynamics; where a robot's surroundings matter they are handed in.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
