"""The contract with the PLC: its variables, their layouts, and what the numbers in them mean.

The contract's other half, in structured text, is in docs/how-to/drive-twincat.md. `layout_of` has
the layout of every variable; `Variables` finds them in the PLC once, compares their sizes with the
layouts, and reads them as structures.

A program that is changed online moves variables. So every read asks for the version of the symbols
in the same request, and variables are written by handle, which such a PLC refuses. Only parts of an
array cannot be written by handle: the version is read before each chunk of set-points, and the PLC
adds up all words that have arrived (`sums_of`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from hil.core import PluginError, RobotConnectionError, StructArray
from hil.robot import Segment
from hil_drivers.twincat.ads import RUN, STATES, Line, Place, changed_online, one
from hil_drivers.twincat.options import Options

CONTRACT = 2
"""Version of the contract; a PLC with another one is not driven."""

TORQUE, CURRENT = 1, 2
"""Values of `nEffort`: what the drives measure."""

TEMPERATURES, EFFORT_TARGETS = 1, 2
"""Bits of `nOffers`: what the PLC measures beside position, speed and effort."""


class Phase(IntEnum):
    """Values of `nPhase`: what the arm is doing."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Order(IntEnum):
    """Values of `nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6


class Result(IntEnum):
    """Values of `nResult` in an answer."""

    DONE = 0
    UNKNOWN = 1
    NOT_YOURS = 2
    HELD = 3
    BUSY = 4
    CHECKSUM = 5
    TOO_MANY = 6
    POSITION = 7
    VELOCITY = 8
    ACCELERATION = 9
    ELSEWHERE = 10
    NOT_LOADED = 11
    STOPPED = 12
    FAULT = 13
    TOO_HEAVY = 14
    NOT_AT_REST = 15
    NO_NUMBER = 16
    JUMP = 17


REASONS: Mapping[int, str] = {
    Result.UNKNOWN: "it does not know this command",
    Result.NOT_YOURS: "somebody else has the arm, or nobody since this connection fell silent",
    Result.HELD: "another client has the arm",
    Result.BUSY: "the arm is moving",
    Result.CHECKSUM: "what it received is not what was sent",
    Result.TOO_MANY: "there are more set-points than it has room for",
    Result.POSITION: "it leaves the joint range",
    Result.VELOCITY: "it is too fast",
    Result.ACCELERATION: "it accelerates too hard",
    Result.ELSEWHERE: "it begins elsewhere than the arm stands",
    Result.NOT_LOADED: "no set-points are loaded",
    Result.STOPPED: "it was stopped meanwhile",
    Result.FAULT: "it has a fault",
    Result.TOO_HEAVY: "the load is too heavy",
    Result.NOT_AT_REST: "it does not begin and end at rest",
    Result.NO_NUMBER: "it holds numbers that are none",
    Result.JUMP: "set-points are farther apart than the joint can go in a cycle",
}
"""Words for the results other than DONE."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Layouts of the PLC's variables for an arm with n joints.

    Attributes:
        types: Variable without prefix → dtype; of arrays, of one element.
    """

    types: Mapping[str, np.dtype[Any]]

    @property
    def row(self) -> np.dtype[Any]:
        """The dtype of a row of the ring."""
        return self.types["aRing"]

    @property
    def set_point(self) -> np.dtype[Any]:
        """The dtype of a row of the trajectory."""
        return self.types["aSetPoints"]


def layout_of(n: int) -> Layout:
    """Return the layouts for n joints; every field lies at a multiple of its size."""
    axes = (n,)
    info = [
        ("fCycleS", "<f8"), ("fWatchdogS", "<f8"), ("fStopRadS2", "<f8"), ("fPayloadMax", "<f8"),
        ("aQMin", "<f8", axes), ("aQMax", "<f8", axes), ("aQdMax", "<f8", axes),
        ("aQddMax", "<f8", axes), ("nAxes", "<u4"), ("nRingRows", "<u4"),
        ("nSetPoints", "<u4"), ("nEffort", "<u4"), ("nOffers", "<u4"), ("nSpare", "<u4"),
        ("sModel", "S32"),
        ("sSerial", "S32"), ("sProgram", "S32"),
    ]  # fmt: skip
    load = [("fMass", "<f8"), ("aCom", "<f8", (3,)), ("aInertia", "<f8", (6,))]
    command = [
        ("nCounter", "<u4"), ("nCommand", "<u4"), *load, ("nSession", "<u4"), ("nSegment", "<i4"),
        ("nRows", "<u4"), ("nSumA", "<u4"), ("nSumB", "<u4"), ("nStop", "<u4"), ("nSpare", "<u4"),
        ("nCounterEnd", "<u4"),
    ]  # fmt: skip
    answer = [
        ("nCounter", "<u4"), ("nResult", "<u4"), *load, ("nSumA", "<u4"), ("nSumB", "<u4"),
        ("nSession", "<u4"), ("nCommand", "<u4"), ("nWhere", "<i4"), ("nCounterEnd", "<u4"),
    ]  # fmt: skip
    state = [
        ("nHead", "<u8"), ("nSession", "<u4"), ("nStop", "<u4"), ("nPhase", "<u4"),
        ("nFault", "<u4"), ("sFault", "S80"),
    ]  # fmt: skip
    targets = ("aQ", "aQd", "aQdd")
    measured = (
        "aQ", "aQd", "aEffort", "aCelsius", "aQTarget", "aQdTarget", "aQddTarget", "aEffortTarget",
    )  # fmt: skip
    row = [
        ("nSequence", "<u8"), ("nTimeNs", "<u8"), *((name, "<f8", axes) for name in measured),
        ("nSegment", "<i4"), ("nStatus", "<u4"), ("nFault", "<u4"), ("nPhase", "<u4"),
        ("nSequenceEnd", "<u8"),
    ]  # fmt: skip
    fields: dict[str, Any] = {
        "nContract": "<u4",
        "stInfo": info,
        "stCommand": command,
        "stAnswer": answer,
        "stBeat": [("nSession", "<u4"), ("nCount", "<u4")],
        "nStop": "<u4",
        "stState": state,
        "aSetPoints": [(name, "<f8", axes) for name in targets],
        "aRing": row,
    }
    return Layout({name: np.dtype(each) for name, each in fields.items()})


LENGTHS = {"aSetPoints": "nSetPoints", "aRing": "nRingRows"}
"""Arrays, each with the field of `stInfo` that has its length."""

WRITTEN_BY_HANDLE = ("stCommand", "stBeat", "nStop")
"""Variables that are written whole: old handles are refused, old offsets are not."""

_DOWNLOAD = "download the PLC program that docs/how-to/drive-twincat.md describes"


class Variables:
    """The variables of the contract, in one PLC.

    Args:
        line: Opened.
        layout: Of the variables.
        options: Of the arm.

    Raises:
        PluginError: A variable is missing, or the program keeps another contract.
        RobotError: The line fails, or the runtime does not run.

    Attributes:
        layout: As given.
        info: `stInfo` as it was read.
        moved: Called once the program turns out to have been changed online, before the error for
            that is raised.
    """

    def __init__(self, line: Line, layout: Layout, options: Options) -> None:
        self._line, self.layout, self._options = line, layout, options
        self.moved: Callable[[], None] = lambda: None
        self._require_running()
        self._version = line.version()
        self._handles: dict[str, Place] = {}
        prefix = options.prefix
        self._places = {name: line.place(f"{prefix}.{name}") for name in layout.types}
        if (contract := int(self.structure("nContract"))) != CONTRACT:
            raise PluginError(
                f"{line.where}: its program keeps version {contract} of the contract, this driver "
                f"{CONTRACT}",
                hint="download the PLC program of docs/how-to/drive-twincat.md, or the hil that "
                "fits",
            )
        for name, kind in layout.types.items():
            self._require_size(name, kind)
        self.info = self.structure("stInfo")
        for name in LENGTHS:
            self._require_length(name)
        for name in WRITTEN_BY_HANDLE:
            self._handles[name] = line.handle(f"{prefix}.{name}")

    def handle(self, name: str) -> Place:
        """Return the handle of one of `WRITTEN_BY_HANDLE`, to be written on another line."""
        return self._handles[name]

    def release(self) -> None:
        """Give the handles back; raises as `Line.read`."""
        for handle in self._handles.values():
            self._line.release(handle)

    def read(
        self, name: str, start: int = 0, size: int | None = None, line: Line | None = None
    ) -> bytes:
        """Read bytes of a variable, unless it has moved.

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
        """Read a variable that is no array; raises as `read`."""
        return one(self.read(name, line=line), self.layout.types[name])

    def command(self, data: bytes) -> None:
        """Write `stCommand`; raises as `read`."""
        self._require_version(self._line.version())
        self._line.write(self._handles["stCommand"], data)

    def newest_row(self) -> np.void:
        """Read the row of the ring that was written last; raises as `read`."""
        rows, size = int(self.info["nRingRows"]), self.layout.row.itemsize
        at = (int(self.structure("stState")["nHead"]) - 1) % rows * size
        return one(self.read("aRing", at, size), self.layout.row)

    def upload(self, segment: Segment) -> dict[str, Any]:
        """Write the set-points of a segment; return the fields of the command that loads them."""
        rows = set_points(segment, self.layout.set_point)
        upload(rows, self._write_set_points, self._options.chunk_bytes)
        a, b = sums_of(rows)
        return {"nRows": len(rows), "nSumA": a, "nSumB": b}

    def _write_set_points(self, data: bytes, start: int) -> None:
        """Write part of the array, which cannot be done by handle: compare the version before."""
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
        if count < 1 or size != count * self.layout.types[name].itemsize:
            raise PluginError(
                f"{self._line.where}: {name} has {size} bytes, stInfo tells of {count} rows",
                hint="let the PLC program fill stInfo from the constants of the arrays",
            )


Write = Callable[[bytes, int], None]
"""Writes bytes into the PLC's array of set-points, from this byte on."""

SUM_MODULO = 2**32


def set_points(segment: Segment, kind: np.dtype[Any]) -> StructArray:
    """Return (N,) rows of the PLC's array for the samples of a segment."""
    rows = np.zeros(len(segment.q), kind)
    rows["aQ"], rows["aQd"], rows["aQdd"] = segment.q, segment.qd, segment.qdd
    return rows


def upload(rows: StructArray, write: Write, chunk_bytes: int) -> None:
    """Write set-points, whole rows at a time.

    Args:
        rows: (N,) set-points.
        write: Called with each chunk and its first byte.
        chunk_bytes: Most that is written at once.
    """
    most = max(1, chunk_bytes // rows.itemsize)
    for first in range(0, len(rows), most):
        write(rows[first : first + most].tobytes(), first * rows.itemsize)


def sums_of(rows: StructArray) -> tuple[int, int]:
    """Return the sum of all 32-bit words, and the sum of its intermediate results, modulo 2³².

    The second sum depends on the order of the words (J. G. Fletcher, 1982).
    """
    words = np.frombuffer(rows.tobytes(), "<u4").astype(np.uint64)
    # Wraps at 2⁶⁴, which keeps what is left modulo 2³².
    weights = np.arange(len(words), 0, -1, dtype=np.uint64)
    return int(words.sum()) % SUM_MODULO, int((weights * words).sum()) % SUM_MODULO
