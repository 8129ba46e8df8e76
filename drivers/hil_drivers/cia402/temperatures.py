"""Motor temperatures, taken from the drives' answers as they pass on the bus.

Whoever owns the bus and whoever reads a log of it hear the same frames, so both know a temperature
from the same cycle on.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil_drivers.cia402.node_watch import SDO_ANSWER_COB_ID

CELSIUS_PER_COUNT = 0.1

_EXPEDITED, _EXPEDITED_MASK = 0x42, 0xE2
"""First byte of an SDO answer to an upload that holds the value itself (CiA 301, 7.2.4.3.5)."""
_ANSWER = struct.Struct("<BHBh")


class Temperatures:
    """Listens for one object.

    Args:
        nodes: Node ids, in the order of the axes.
        index: Of the object, INTEGER16 in 0.1 °C; 0 where there is none.

    Attributes:
        celsius: (n,) as last heard [°C], NaN before.
    """

    def __init__(self, nodes: Sequence[int], index: int) -> None:
        self._axes = {SDO_ANSWER_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._index = index
        self.celsius: FloatArray = np.full(len(nodes), np.nan)

    def heard(self, can_id: int, data: bytes) -> None:
        """A frame; all but answers that tell that object are passed over."""
        axis = self._axes.get(can_id)
        if axis is None or not self._index or len(data) < _ANSWER.size:
            return
        command, index, sub, count = _ANSWER.unpack_from(data)
        if command & _EXPEDITED_MASK == _EXPEDITED and (index, sub) == (self._index, 0):
            self.celsius[axis] = count * CELSIUS_PER_COUNT
