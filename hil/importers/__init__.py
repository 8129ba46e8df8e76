"""Datasets of run directories and of recordings of other tools, and the way back.

`sources` turns a run directory or MCAP file into a dataset, `foreign_recordings` turns a file of
another tool (CSV, MATLAB, ROS 2 bag, ur_rtde, one value per line) into an MCAP file, and
`sample_export` writes samples for other programs. `hil.data` is pure and imports none of this.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
