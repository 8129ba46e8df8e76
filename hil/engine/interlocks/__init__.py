"""Interlocks: judged on every state sample, in blocks, by level and not by edge.

A quantity an interlock needs and the robot does not deliver while it moves trips too: what cannot
be seen is not safe (temperatures excepted, which not every arm measures).
"""

from hil.engine.interlocks.collection import Interlocks, Off
from hil.engine.interlocks.context import Distances, InterlockContext
from hil.engine.interlocks.from_spec import interlocks_from_spec
from hil.engine.interlocks.interlock import Action, HasMargin, Interlock, Margin, Trip
from hil.engine.interlocks.least_distance import LeastDistance
from hil.engine.interlocks.recording import Backlog, FreeSpace
from hil.engine.interlocks.speed_scaling import SpeedScaling, is_slowed
from hil.engine.interlocks.threshold import Threshold

__all__ = [
    "Action",
    "Backlog",
    "Distances",
    "FreeSpace",
    "HasMargin",
    "Interlock",
    "InterlockContext",
    "Interlocks",
    "LeastDistance",
    "Margin",
    "Off",
    "SpeedScaling",
    "Threshold",
    "Trip",
    "interlocks_from_spec",
    "is_slowed",
]
