"""The PLC's variables: found by name once, checked against the contract, read as structures."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.errors import PluginError, RobotConnectionError
from hil.robot import Segment
from hil_drivers.twincat.facts import require_contract
from hil_drivers.twincat.line import Line, Place, one
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.return_codes import RUN, STATES
from hil_drivers.twincat.ring import Ring
from hil_drivers.twincat.symbols import Layout
from hil_drivers.twincat.upload import set_points, sums_of, upload

LENGTHS = {"aSetPoints": "nSetPoints", "aRing": "nRingRows"}
"""Arrays, and which field of `stInfo` tells their length."""

_DOWNLOAD = "download the PLC program that docs/how-to/drive-twincat.md describes"


class Variables:
    """What the contract has in the PLC.

    Args:
        line: Opened.
        layout: Of the variables.
        options: Of the arm.

    Raises:
        PluginError: A variable is missing, or the program keeps another contract.
        RobotError: The line fails, or the runtime does not run.

    Attributes:
        info: `stInfo` as it was read.
    """

    def __init__(self, line: Line, layout: Layout, options: Options) -> None:
        self._line, self._layout, self._options = line, layout, options
        self._require_running()
        prefix = options.prefix
        self._places = {name: line.place(f"{prefix}.{name}") for name in layout.types}
        require_contract(line.where, int(self.structure("nContract")))
        for name, kind in layout.types.items():
            self._require_size(name, kind)
        self.info = self.structure("stInfo")
        for name in LENGTHS:
            self._require_length(name)

    def place(self, name: str) -> Place:
        """Where a variable is, for whoever has a line of its own."""
        return self._places[name]

    def structure(self, name: str) -> np.void:
        """A variable that is no array, now; raises as `Line.read`."""
        return one(self._line.read(self._places[name]), self._layout.types[name])

    def write(self, name: str, data: bytes, start: int = 0) -> None:
        """Change bytes of a variable; raises as `Line.read`."""
        self._line.write(self._places[name], data, start)

    def newest_row(self) -> np.void:
        """The row of the ring that was written last."""
        rows, size = int(self.info["nRingRows"]), self._layout.row.itemsize
        at = (int(self.structure("stState")["nHead"]) - 1) % rows * size
        return one(self._line.read(self._places["aRing"], at, size), self._layout.row)

    def ring(self) -> Ring:
        """The ring, from now on."""
        place = self._places["aRing"]
        ring = Ring(
            lambda at, size: self._line.read(place, at, size),
            self._layout.row,
            int(self.info["nRingRows"]),
            self._options.chunk_bytes,
        )
        ring.begin(int(self.structure("stState")["nHead"]))
        return ring

    def upload(self, segment: Segment) -> dict[str, Any]:
        """Write the set-points of a segment; returns the fields of the command that loads them."""
        rows = set_points(segment, self._layout.set_point)
        upload(
            rows,
            lambda data, start: self.write("aSetPoints", data, start),
            self._options.chunk_bytes,
        )
        a, b = sums_of(rows)
        return {"nRows": len(rows), "nSumA": a, "nSumB": b}

    def _require_running(self) -> None:
        state = self._line.state()
        if state != RUN:
            raise RobotConnectionError(
                f"{self._line.where}: its runtime is in state {STATES.get(state, state)}",
                hint="bring TwinCAT into run mode and start the PLC",
            )

    def _require_size(self, name: str, kind: np.dtype[Any]) -> None:
        size = self._places[name].size
        if size % kind.itemsize if name in LENGTHS else size != kind.itemsize:
            raise PluginError(
                f"{self._line.where}: {name} has {size} bytes, the contract says "
                f"{kind.itemsize}{' a row' if name in LENGTHS else ''}",
                hint=_DOWNLOAD,
            )

    def _require_length(self, name: str) -> None:
        size, count = self._places[name].size, int(self.info[LENGTHS[name]])
        if count < 1 or size != count * self._layout.types[name].itemsize:
            raise PluginError(
                f"{self._line.where}: {name} has {size} bytes, stInfo tells of {count} rows",
                hint="let the PLC program fill stInfo from the constants of the arrays",
            )
