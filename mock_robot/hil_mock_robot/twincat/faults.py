"""What is to go wrong with a mock PLC, and when: `--faults FILE`, and requests of the side file."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hil_mock_robot.server.faults import FaultList, Number

KINDS: dict[str, tuple[str, ...]] = {
    "drive_fault": ("for_s", "code"),
    "emergency_stop": ("for_s",),
    "freeze": ("for_s",),
    "silence": ("for_s",),
    "cut": ("for_s",),
    "config": ("for_s",),
    "restart": (),
    "online_change": (),
    "lose_stops": ("for_s",),
    "spoil": ("for_s",),
    "refuse": ("code",),
}
"""What can go wrong, and which further keys each kind has (docs/how-to/drive-twincat.md)."""

COUNTED = ("motion",)
OWN_DURATION = {"drive_fault": 0.0, "restart": 0.0, "refuse": 0.0, "cut": 0.0, "online_change": 0.0}
"""How long these last when nothing is said; the others last until they are cleared."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once.

    Attributes:
        kind: One of `KINDS`.
        at_s: Time since the mock was started at which it begins, in device time.
        motion: Which motion it follows, counted from 1.
        after_s: Device time since that began.
        for_s: Device time it lasts.
        code: Of the fault, or the result that the next command is refused with.
    """

    kind: str
    at_s: float | None = None
    motion: int | None = None
    after_s: float = 0.0
    for_s: float = math.inf
    code: int = 0


_LIST = FaultList(
    Fault,
    kinds=KINDS,
    counted=COUNTED,
    numbers={"code": Number(1, 65535, True, "a whole number from 1 to 65535")},
    durations=OWN_DURATION,
    example="{kind: silence, at_s: 2.0}",
)
read_faults, fault_of = _LIST.read, _LIST.one_of
