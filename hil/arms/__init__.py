"""Published data of built-in arms, used for identification and by the mock.

Kinematics, joint limits, nominal masses and collision capsules of the arms come from the
manufacturers. The YAML files in this folder state the source of each value. No value describes an
individual robot: the mock contains separate true parameters, and fitted models contain estimated
parameters.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
