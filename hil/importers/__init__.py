"""Datasets from run directories and from recordings of other tools, and back.

Runs and MCAP files, CSV, MATLAB, ROS 2 bags, ur_rtde, one value per line; `hil.data` is pure and
imports none of this.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
