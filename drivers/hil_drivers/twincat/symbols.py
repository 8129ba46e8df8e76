"""The contract with the PLC: names, layouts, numbers.

Its other half, in structured text, is in docs/how-to/drive-twincat.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

CONTRACT = 2
"""Version of it; a PLC with another one is not driven."""

DEFAULT_PREFIX = "GVL_Hil"
TORQUE, CURRENT = 1, 2
"""`nEffort`."""

TEMPERATURES, EFFORT_TARGETS = 1, 2
"""Bits of `nOffers`."""


class Phase(IntEnum):
    """`nPhase`: what the arm is doing."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Order(IntEnum):
    """`nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6


class Result(IntEnum):
    """`nResult` of an answer."""

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
"""What the PLC means by the results other than DONE."""


@dataclass(frozen=True, slots=True)
class Layout:
    """What the PLC's variables look like for an arm with n joints.

    Attributes:
        types: Variable without prefix → dtype; of arrays, of one element.
    """

    types: Mapping[str, np.dtype[Any]]

    @property
    def row(self) -> np.dtype[Any]:
        """A row of the ring."""
        return self.types["aRing"]

    @property
    def set_point(self) -> np.dtype[Any]:
        """A row of the trajectory."""
        return self.types["aSetPoints"]


def layout_of(n: int) -> Layout:
    """Layouts for n joints; every field lies at a multiple of its size."""
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
