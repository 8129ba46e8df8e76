"""The PLC's variables: found by name once, checked against the contract, read as structures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hil.core import PluginError, RobotConnectionError
from hil.robot import Segment
from hil_drivers.twincat.facts import require_contract
from hil_drivers.twincat.line import Line
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.places import Place, one
from hil_drivers.twincat.return_codes import RUN, STATES, changed_online
from hil_drivers.twincat.ring import Ring
from hil_drivers.twincat.symbols import Layout
from hil_drivers.twincat.upload import set_points, sums_of, upload

LENGTHS = {"aSetPoints": "nSetPoints", "aRing": "nRingRows"}
"""Arrays, and which field of `stInfo` tells their length."""

WRITTEN = ("stCommand", "stBeat", "nStop")
"""Variables that are written whole, by handle: old handles are refused, old offsets are not."""

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
        moved: Called when the program turns out to have been changed online, before that is told.
    """

    def __init__(self, line: Line, layout: Layout, options: Options) -> None:
        self._line, self._layout, self._options = line, layout, options
        self.moved: Callable[[], None] = lambda: None
        self._require_running()
        self._version = line.version()
        self._handles: dict[str, Place] = {}
        prefix = options.prefix
        self._places = {name: line.place(f"{prefix}.{name}") for name in layout.types}
        require_contract(line.where, int(self.structure("nContract")))
        for name, kind in layout.types.items():
            self._require_size(name, kind)
        self.info = self.structure("stInfo")
        for name in LENGTHS:
            self._require_length(name)
        for name in WRITTEN:
            self._handles[name] = line.handle(f"{prefix}.{name}")

    def handle(self, name: str) -> Place:
        """One of `WRITTEN`, for whoever has a line of its own."""
        return self._handles[name]

    def release(self) -> None:
        """Give the handles back; raises as `Line.read`."""
        for handle in self._handles.values():
            self._line.release(handle)

    def read(
        self, name: str, start: int = 0, size: int | None = None, line: Line | None = None
    ) -> bytes:
        """Bytes of a variable, unless it lies elsewhere by now.

        Args:
            name: Of the variable.
            start: First byte.
            size: How many; all when None.
            line: To read it on; the one of all others when None.

        Raises:
            RobotFault: The program was changed online.
            RobotError: As `Line.read`.
        """
        data, version = (line or self._line).read_versioned(self._places[name], start, size)
        self._require_version(version)
        return data

    def structure(self, name: str, line: Line | None = None) -> np.void:
        """A variable that is no array, now; raises as `read`."""
        return one(self.read(name, line=line), self._layout.types[name])

    def command(self, data: bytes) -> None:
        """Write `stCommand`; raises as `read`."""
        self._require_version(self._line.version())
        self._line.write(self._handles["stCommand"], data)

    def newest_row(self) -> np.void:
        """The row of the ring that was written last."""
        rows, size = int(self.info["nRingRows"]), self._layout.row.itemsize
        at = (int(self.structure("stState")["nHead"]) - 1) % rows * size
        return one(self.read("aRing", at, size), self._layout.row)

    def ring(self) -> Ring:
        """The ring, from now on."""
        ring = Ring(
            lambda at, size: self.read("aRing", at, size),
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
            self._write_set_points,
            self._options.chunk_bytes,
        )
        a, b = sums_of(rows)
        return {"nRows": len(rows), "nSumA": a, "nSumB": b}

    def _write_set_points(self, data: bytes, start: int) -> None:
        """Part of an array cannot be written by handle: look at the version before each."""
        self._require_version(self._line.version())
        self._line.write(self._places["aSetPoints"], data, start)

    def _require_version(self, version: int) -> None:
        if version != self._version:
            self.moved()
            raise changed_online(self._line.where)

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
