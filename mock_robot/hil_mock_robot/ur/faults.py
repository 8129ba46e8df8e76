"""What is to go wrong with a mock UR controller, and when: `--faults FILE` and the side channel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hil_mock_robot.server.faults import COUNT, FaultList, Number

KINDS: dict[str, tuple[str, ...]] = {
    "cut": ("for_s", "only"),
    "unplugged": ("for_s",),
    "silence": ("for_s",),
    "jitter": ("by_s", "for_s"),
    "late": ("by_s", "for_s"),
    "freeze": ("for_s",),
    "drop": ("packages",),
    "duplicate": ("packages",),
    "wrong_length": ("packages", "by_bytes"),
    "garbage": ("packages",),
    "protective_stop": ("code",),
    "emergency_stop": (),
    "safeguard_stop": ("for_s",),
    "safety_fault": (),
    "overheat": ("joint", "celsius"),
    "reboot": ("for_s", "powered"),
    "inputs_owned": ("for_s",),
    "remote_off": ("for_s",),
    "payload_refused": ("for_s",),
    "dashboard_hang": ("for_s",),
}
"""What can go wrong, and which further keys each kind has (docs/reference/mock-ur-faults.md)."""

COUNTED = ("motion", "program")
WHEN = ("at_s", *COUNTED, "after_s")
OWN_DURATION = {"cut": 0.0, "reboot": 3.0}
"""How long these last when nothing is said; the others last until they are cleared."""

OWNERS = "inputs"
"""Of the connections, those whose client has inputs of RTDE."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once.

    Attributes:
        kind: One of `KINDS`.
        at_s: Time since the mock was started at which it begins, in device time.
        motion, program: Which motion or program it follows, counted from 1.
        after_s: Device time since that began.
        for_s: Device time it lasts.
        by_s: How late packages come, or how late at most.
        packages: How many are lost, sent twice or spoilt, for each client that is connected.
        by_bytes: How much too long they are.
        code: UR's number C… of the protective stop.
        joint: From 1, the base, to 6.
        celsius: How hot it is at once.
        only: `inputs`: of the connections, only those that own inputs are cut, and once.
        powered: Whether the arm is switched on after the reboot.
    """

    kind: str
    at_s: float | None = None
    motion: int | None = None
    program: int | None = None
    after_s: float = 0.0
    for_s: float = math.inf
    by_s: float = 0.0
    packages: int = 1
    by_bytes: int = -8
    code: int = 158
    joint: int = 2
    celsius: float = 90.0
    powered: bool = False
    only: str = ""


_LIST = FaultList(
    Fault,
    kinds=KINDS,
    counted=COUNTED,
    numbers={
        "by_s": Number(0, 60, False, "a number of seconds from 0 to 60"),
        "packages": COUNT,
        "by_bytes": Number(-1000, 1000, True, "a whole number of bytes, −1000 to 1000"),
        "code": Number(100, 999, True, "a UR error code, 100 to 999"),
        "joint": Number(1, 6, True, "a joint from 1, the base, to 6"),
        "celsius": Number(-50, 200, False, "a temperature from −50 to 200 °C"),
    },
    words={
        "powered": (lambda given: isinstance(given, bool), "use true or false"),
        "only": (
            lambda given: given == OWNERS,
            f"use {OWNERS}, or leave it away to cut all connections",
        ),
    },
    required={"jitter": "by_s", "late": "by_s"},
    durations=OWN_DURATION,
    example="{kind: silence, at_s: 2.0}",
)
read_faults, faults_of, fault_of = _LIST.read, _LIST.all_of, _LIST.one_of
