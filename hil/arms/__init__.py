"""Published facts about built-in arms: neutral data that identification and mock may both read.

Kinematics, limits, nominal masses and collision capsules come from the makers and carry their
source in the YAML beside this file. Nothing here says what a *particular* robot is like: truth
lives in the mock, estimates live in models.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
