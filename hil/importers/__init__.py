"""Datasets from run directories and from recordings of other tools, and back.

Runs and MCAP files, CSV, MATLAB, ROS 2 bags, ur_rtde, one value per line; `hil.data` is pure and
imports none of this.
"""

from hil.importers.import_map import ImportMap, load_map
from hil.importers.importer import ImportReport, import_file

__all__ = ["ImportMap", "ImportReport", "import_file", "load_map"]
