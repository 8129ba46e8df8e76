"""What the PLC checks of set-points before it plays them: their sums, limits, ends and steps."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from hil.core import FloatArray, StructArray

START_RAD = 1e-3
REST_RAD_S = 0.01
STEP_SHARE = 1.05
"""Of the way that the highest velocity makes in a cycle: farther apart set-points are a jump."""

SLACK_RAD, SLACK_SHARE = 1e-6, 1.001


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


def sums_of(rows: StructArray) -> tuple[int, int]:
    """Both sums of a block, word by word as the PLC adds them up: modulo 2³²."""
    a = np.cumsum(rows.view(np.uint32), dtype=np.uint32)
    return int(a[-1]), int(np.sum(a, dtype=np.uint32))


def refusal_of(
    rows: StructArray, info: np.void, standing: FloatArray, cycle_s: float
) -> tuple[Result, int]:
    """Why set-points are not played, and the axis that it is about.

    Args:
        rows: (N,) set-points.
        info: `stInfo`, with the limits.
        standing: (n,) the commanded position now [rad].
        cycle_s: Time between two set-points [s].
    """
    q, qd, qdd = rows["aQ"], rows["aQd"], rows["aQdd"]
    outside = np.maximum(info["aQMin"] - q, q - info["aQMax"])
    steps = np.abs(np.diff(q, axis=0)) - STEP_SHARE * cycle_s * info["aQdMax"]
    checks = (
        (Result.NO_NUMBER, ~(np.isfinite(q) & np.isfinite(qd) & np.isfinite(qdd))),
        (Result.ELSEWHERE, np.abs(q[:1] - standing) > START_RAD),
        (Result.NOT_AT_REST, np.abs(qd[[0, -1]]) > REST_RAD_S),
        (Result.POSITION, outside > SLACK_RAD),
        (Result.VELOCITY, np.abs(qd) > SLACK_SHARE * info["aQdMax"]),
        (Result.ACCELERATION, np.abs(qdd) > SLACK_SHARE * info["aQddMax"]),
        (Result.JUMP, steps > SLACK_RAD),
    )
    for result, wrong in checks:
        if wrong.any():
            return result, int(wrong.any(axis=0).argmax())
    return Result.DONE, -1
