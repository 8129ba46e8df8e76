"""RPDOs and TPDOs of all axes as 16-byte frames in two blocks of memory, packed at one go."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from hil.can import FRAME
from hil_drivers.cia402.contracts import ByteArray, Inputs, Outputs
from hil_drivers.cia402.mapping import MOST_BYTES, Mapping, Pdo, rpdo_cob_id, tpdo_cob_id

_HEAD = FRAME.size - MOST_BYTES


class Commands:
    """The RPDOs of one cycle.

    Args:
        mapping, nodes: Of the arm.

    Attributes:
        frames: Views of 16 bytes, in the order in which they are sent.
        data: (R, n, 8) the data bytes of the same.
    """

    def __init__(self, mapping: Mapping, nodes: Sequence[int]) -> None:
        pdos, n = mapping.rpdos, len(nodes)
        self._memory = bytearray(FRAME.size * n * len(pdos))
        self._heads = [
            (rpdo_cob_id(pdo.number, node), pdo.length) for pdo in pdos for node in nodes
        ]
        self._packing = struct.Struct("<" + "".join(_code(pdo) * n for pdo in pdos))
        self._fields = [[entry.name for entry in pdo.entries] for pdo in pdos]
        # Identifiers and lengths never change: their places in the list of values are filled once.
        self._values: list[int] = []
        self._places: list[tuple[str, slice]] = []
        for number, names in enumerate(self._fields):
            width, start = len(names) + 2, len(self._values)
            for head in self._heads[number * n : (number + 1) * n]:
                self._values += [*head, *[0] * len(names)]
            for at, name in enumerate(names):
                self._places.append((name, slice(start + 2 + at, start + width * n, width)))
        self.frames = _views(self._memory)
        self.data = _data(self._memory, len(pdos), n)

    def pack(self, outputs: Outputs) -> None:
        """Write the frames anew."""
        values = self._values
        for name, places in self._places:
            values[places] = getattr(outputs, name)
        self._packing.pack_into(self._memory, 0, *values)


class Answers:
    """The TPDOs of one cycle, in the order PDO by PDO, axis by axis: their slots.

    Args:
        mapping, nodes: Of the arm.

    Attributes:
        slots: First five bytes of a frame (identifier, length) → the slot it belongs to.
        memory: Frames by slot, 16 bytes each.
        data: (T, n, 8) the data bytes of the same.
        cob_ids: Of all slots.
        all_fresh: `Inputs.fresh` when all came.
    """

    def __init__(self, mapping: Mapping, nodes: Sequence[int]) -> None:
        pdos, self._n = mapping.tpdos, len(nodes)
        self.all_fresh = [True] * self._n
        self.memory = bytearray(FRAME.size * len(nodes) * len(pdos))
        heads = [(tpdo_cob_id(pdo.number, node), pdo.length) for pdo in pdos for node in nodes]
        self.slots = {struct.pack("<IB", *head): slot for slot, head in enumerate(heads)}
        self.cob_ids = frozenset(cob_id for cob_id, _ in heads)
        self.data = _data(self.memory, len(pdos), self._n)
        self._packing = struct.Struct("<" + "".join(_skipping_head(pdo) * self._n for pdo in pdos))
        self._places: list[tuple[str, slice]] = []
        start = 0
        for pdo in pdos:
            width = len(pdo.entries)
            for at, entry in enumerate(pdo.entries):
                self._places.append((entry.name, slice(start + at, start + width * self._n, width)))
            start += width * self._n

    def __len__(self) -> int:
        return len(self.slots)

    def axis(self, slot: int) -> int:
        """Whose slot it is."""
        return slot % self._n

    def unpack(self, inputs: Inputs) -> None:
        """Write the values of all slots."""
        values = self._packing.unpack_from(self.memory)
        for name, places in self._places:
            getattr(inputs, name)[:] = values[places]


def _code(pdo: Pdo) -> str:
    return "IB3x" + _codes(pdo)


def _skipping_head(pdo: Pdo) -> str:
    return f"{_HEAD}x" + _codes(pdo)


def _codes(pdo: Pdo) -> str:
    codes = "".join(entry.code for entry in pdo.entries)
    return f"{codes}{MOST_BYTES - pdo.length}x"


def _views(memory: bytearray) -> list[memoryview]:
    whole = memoryview(memory)
    return [whole[at : at + FRAME.size] for at in range(0, len(memory), FRAME.size)]


def _data(memory: bytearray, pdos: int, n: int) -> ByteArray:
    frames = np.frombuffer(memory, dtype=np.uint8).reshape(pdos, n, FRAME.size)
    return frames[:, :, _HEAD:]
