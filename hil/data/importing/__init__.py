"""Recordings of other tools: CSV, MATLAB, ROS 2 bags, ur_rtde, one value per line.

Only this package and `hil.data.load` touch the recorder; nothing here is imported by `hil.data`.
"""

from hil.data.importing.import_map import ImportMap, load_map
from hil.data.importing.importer import ImportReport, import_file

__all__ = ["ImportMap", "ImportReport", "import_file", "load_map"]
