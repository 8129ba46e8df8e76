"""Datasets from run directories and from recordings of other tools, and export of samples.

The module `sources` converts a run directory or MCAP file into a dataset, `foreign_recordings`
converts a file of a different tool (CSV, MATLAB, ROS 2 bag, ur_rtde, one value per line) into an
MCAP file, and `sample_export` writes samples for other programs. The package `hil.data` does not
import `hil.importers`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
