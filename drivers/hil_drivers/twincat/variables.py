"""Contract with the PLC: the variables, their layouts, and the meanings of their values.

The PLC's side of the contract, in structured text, is in docs/how-to/drive-twincat.md. `layout_of`
returns the layout of every variable. When connecting, `Variables` requests the addresses of the
variables and compares their sizes with the layouts. Later `Variables` reads the variables as
structures.

Online changes of the PLC program can move variables in memory. For this reason, every read also
requests the symbol version, and variables are written by handle, because a changed PLC program
rejects old handles. Parts of an array cannot be written by handle. For the array of set-points, the
driver therefore reads the symbol version before each chunk of set-points, and the PLC computes
checksums of the received words (`sums_of`).
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
"""Version of the contract; the driver rejects a PLC with a different version."""

TORQUE, CURRENT = 1, 2
"""Values of `nEffort`, which states the quantity that the drives measure."""

TEMPERATURES, EFFORT_TARGETS = 1, 2
"""Bits of `nOffers`, which states the measured quantities besides position, speed and effort."""


class Phase(IntEnum):
    """Phase of the arm, as encoded in `nPhase`."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Order(IntEnum):
    """Command to the PLC, as encoded in `nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6


class Result(IntEnum):
    """Result of a command, as encoded in `nResult` of an answer."""

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
    Result.UNKNOWN: "the PLC does not know this command",
    Result.NOT_YOURS: "this client does not control the arm: another client does, or the PLC has "
    "released the arm because no heartbeat arrived",
    Result.HELD: "another client controls the arm",
    Result.BUSY: "the arm is moving",
    Result.CHECKSUM: "the received set-points differ from those sent",
    Result.TOO_MANY: "there are more set-points than the PLC can store",
    Result.POSITION: "a set-point is outside the joint range",
    Result.VELOCITY: "the velocity is too high",
    Result.ACCELERATION: "the acceleration is too high",
    Result.ELSEWHERE: "the segment does not begin at the present position of the arm",
    Result.NOT_LOADED: "no set-points are loaded",
    Result.STOPPED: "the arm was stopped meanwhile",
    Result.FAULT: "the arm is in a fault",
    Result.TOO_HEAVY: "the payload is too heavy",
    Result.NOT_AT_REST: "the segment does not begin and end at standstill",
    Result.NO_NUMBER: "a value is not a finite number",
    Result.JUMP: "set-points are farther apart than the joint can move in a cycle",
}
"""Message text of each result except DONE."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Layouts of the PLC's variables for an arm with n joints.

    Attributes:
        types: NumPy dtype of each variable, by the name without prefix; for an array, the dtype of
            one element.
    """

    types: Mapping[str, np.dtype[Any]]

    @property
    def row(self) -> np.dtype[Any]:
        """NumPy dtype of one row of the ring buffer."""
        return self.types["aRing"]

    @property
    def set_point(self) -> np.dtype[Any]:
        """NumPy dtype of one row of the trajectory."""
        return self.types["aSetPoints"]


def layout_of(n: int) -> Layout:
    """Return the layouts for n joints; every field is aligned to a multiple of its size."""
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
"""Name of the `stInfo` field that contains the length, for each array."""

WRITTEN_BY_HANDLE = ("stCommand", "stBeat", "nStop")
"""Variables that are written as a whole, by handle, because the PLC rejects old handles."""

_DOWNLOAD = "download the PLC program that docs/how-to/drive-twincat.md describes"


class Variables:
    """Access to the contract's variables in one PLC.

    Args:
        line: Open line to the PLC.
        layout: Layouts of the variables.
        options: Options of the arm.

    Raises:
        PluginError: A variable is missing, or the PLC's program implements a different version of
            the contract.
        RobotError: The request on the line failed, or the PLC's runtime is not running.

    Attributes:
        layout: Layouts of the variables.
        info: Structure `stInfo` as read when connecting.
        moved: Callback that is called before the error for a program that was changed online is
            raised.
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
                f"{line.where}: its program implements version {contract} of the contract, this "
                f"driver version {CONTRACT}",
                hint="download the PLC program of docs/how-to/drive-twincat.md, or install the "
                "matching version of hil",
            )
        for name, kind in layout.types.items():
            self._require_size(name, kind)
        self.info = self.structure("stInfo")
        for name in LENGTHS:
            self._require_length(name)
        for name in WRITTEN_BY_HANDLE:
            self._handles[name] = line.handle(f"{prefix}.{name}")

    def handle(self, name: str) -> Place:
        """Return the handle of a variable in `WRITTEN_BY_HANDLE`, for writing on another line."""
        return self._handles[name]

    def release(self) -> None:
        """Release all handles in the PLC; raise the same exceptions as `Line.read`."""
        for handle in self._handles.values():
            self._line.release(handle)

    def read(
        self, name: str, start: int = 0, size: int | None = None, line: Line | None = None
    ) -> bytes:
        """Read bytes of a variable; raise if the program was changed online.

        Args:
            name: Name of the variable.
            start: Offset of the first byte.
            size: Number of bytes; None for all bytes after `start`.
            line: Line for the request; None for the default line.

        Raises:
            RobotFault: The program of the PLC was changed online.
            RobotError: The request failed; see `Line.read`.
        """
        data, version = (line or self._line).read_versioned(self._places[name], start, size)
        self._require_version(version)
        return data

    def structure(self, name: str, line: Line | None = None) -> np.void:
        """Read a variable that is not an array; raise the same exceptions as `read`."""
        return one(self.read(name, line=line), self.layout.types[name])

    def command(self, data: bytes) -> None:
        """Write the variable `stCommand`; raise the same exceptions as `read`."""
        self._require_version(self._line.version())
        self._line.write(self._handles["stCommand"], data)

    def newest_row(self) -> np.void:
        """Read the newest row of the ring buffer; raise the same exceptions as `read`."""
        rows, size = int(self.info["nRingRows"]), self.layout.row.itemsize
        at = (int(self.structure("stState")["nHead"]) - 1) % rows * size
        return one(self.read("aRing", at, size), self.layout.row)

    def upload(self, segment: Segment) -> dict[str, Any]:
        """Write the set-points of a segment; return the fields of the LOAD command."""
        rows = set_points(segment, self.layout.set_point)
        upload(rows, self._write_set_points, self._options.chunk_bytes)
        a, b = sums_of(rows)
        return {"nRows": len(rows), "nSumA": a, "nSumB": b}

    def _write_set_points(self, data: bytes, start: int) -> None:
        """Write part of the set-points after a check of the symbol version instead of a handle."""
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
                f"{self._line.where}: {name} has {size} bytes, the contract requires "
                f"{kind.itemsize}{' per row' if name in LENGTHS else ''}",
                hint=_DOWNLOAD,
            )

    def _require_length(self, name: str) -> None:
        size, count = self._places[name].size, int(self.info[LENGTHS[name]])
        if count < 1 or size != count * self.layout.types[name].itemsize:
            raise PluginError(
                f"{self._line.where}: {name} has {size} bytes, stInfo reports {count} rows",
                hint="let the PLC program set stInfo from the constants of the arrays",
            )


Write = Callable[[bytes, int], None]
"""Function that writes data into the PLC's array of set-points at a byte offset."""

SUM_MODULO = 2**32


def set_points(segment: Segment, kind: np.dtype[Any]) -> StructArray:
    """Return the N samples of a segment as rows of the PLC's array of set-points."""
    rows = np.zeros(len(segment.q), kind)
    rows["aQ"], rows["aQd"], rows["aQdd"] = segment.q, segment.qd, segment.qdd
    return rows


def upload(rows: StructArray, write: Write, chunk_bytes: int) -> None:
    """Write set-points in chunks of whole rows.

    Args:
        rows: (N,) set-points.
        write: Function called with each chunk and the offset of its first byte.
        chunk_bytes: Maximum number of bytes in a chunk.
    """
    most = max(1, chunk_bytes // rows.itemsize)
    for first in range(0, len(rows), most):
        write(rows[first : first + most].tobytes(), first * rows.itemsize)


def sums_of(rows: StructArray) -> tuple[int, int]:
    """Return the two Fletcher checksums of set-points, modulo 2³².

    Of the two checksums, the first is the sum of all 32-bit words. The second Fletcher checksum is
    the sum of the intermediate sums, and therefore depends on the order of the words (Fletcher,
    1982).
    """
    words = np.frombuffer(rows.tobytes(), "<u4").astype(np.uint64)
    # The products wrap at 2⁶⁴, which does not change the result modulo 2³².
    weights = np.arange(len(words), 0, -1, dtype=np.uint64)
    return int(words.sum()) % SUM_MODULO, int((weights * words).sum()) % SUM_MODULO
