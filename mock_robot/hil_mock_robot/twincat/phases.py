"""Numbers of the contract that the PLC's program works with."""

from __future__ import annotations

from enum import IntEnum

MOVING, HOLDING, FAULT, MASKED = 1, 2, 4, 8
"""Bits of a row's `nStatus`."""


class Phase(IntEnum):
    """`nPhase`."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Command(IntEnum):
    """`nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6
