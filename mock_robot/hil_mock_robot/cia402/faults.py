"""What is to go wrong with the mock drives, and when: `--faults FILE` and the side channel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from hil_mock_robot.server.faults import COUNT, FaultList, Number

KINDS: dict[str, tuple[str, ...]] = {
    "emergency": ("axis", "code"),
    "following_error": ("axis",),
    "overcurrent": ("axis",),
    "overheat": ("axis", "celsius"),
    "heartbeat_loss": ("axis", "for_s"),
    "node_reboot": ("axis", "for_s"),
    "refused_mode": ("axis", "for_s"),
    "bit12_low": ("axis", "for_s"),
    "sync_ignored": ("axis", "for_s"),
    "mapping_refused": ("axis", "for_s"),
    "sdo_abort": ("axis", "index", "abort", "for_s"),
    "sdo_silent": ("axis", "for_s"),
    "lost_frames": ("axis", "frames"),
    "late_frames": ("axis", "by_s", "for_s"),
    "wrong_length": ("axis", "frames", "by_bytes"),
    "bus_off": ("axis", "for_s"),
}
"""What can go wrong, and which further keys each kind has (docs/reference/mock-can-faults.md)."""

COUNTED = ("motion",)
WHEN = ("at_s", *COUNTED, "after_s")
OWN_DURATION = {"node_reboot": 0.5}
"""How long these last when nothing is said; the others last until they are cleared."""

ALL, MASTER = "all", "master"
MOST_AXES = 16


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once.

    Attributes:
        kind: One of `KINDS`.
        at_s: Device time since the mock was started at which it begins.
        motion: Which motion it follows, counted from 1.
        after_s: Device time since that began.
        for_s: Device time it lasts.
        axis: From 1; `all`; or `master`, whose end of the bus it is.
        code: Error code of the emergency.
        celsius: How hot the motor is at once.
        index: Object that is refused; 0 for all.
        abort: Abort code of the refusal.
        frames: How many TPDOs are lost or spoilt, of each axis.
        by_bytes: How much too long they are.
        by_s: How late they come.
    """

    kind: str
    at_s: float | None = None
    motion: int | None = None
    after_s: float = 0.0
    for_s: float = math.inf
    axis: int | str = 2
    code: int = 0xFF01
    celsius: float = 120.0
    index: int = 0
    abort: int = 0x0800_0022
    frames: int = 1
    by_bytes: int = -1
    by_s: float = 0.0

    @property
    def axes(self) -> range:
        """Which axes it strikes, from 0; none where it strikes the master."""
        if isinstance(self.axis, str):
            return range(MOST_AXES if self.axis == ALL else 0)
        return range(self.axis - 1, self.axis)


def _is_axis(given: Any) -> bool:
    if isinstance(given, str):
        return given in (ALL, MASTER)
    return isinstance(given, int) and not isinstance(given, bool) and 1 <= given <= MOST_AXES


_LIST = FaultList(
    Fault,
    kinds=KINDS,
    counted=COUNTED,
    numbers={
        "code": Number(1, 0xFFFF, True, "an error code, 0x0001 to 0xFFFF"),
        "index": Number(0, 0xFFFF, True, "an index of an object, or 0 for all"),
        "abort": Number(1, 0xFFFF_FFFF, True, "an abort code, such as 0x06090030"),
        "celsius": Number(-50, 300, False, "a temperature from −50 to 300 °C"),
        "frames": COUNT,
        "by_bytes": Number(-8, 8, True, "a whole number of bytes, −8 to 8"),
        "by_s": Number(0, 60, False, "a number of seconds from 0 to 60"),
    },
    words={"axis": (_is_axis, "use a number from 1, all, or master (bus_off only)")},
    required={"late_frames": "by_s"},
    durations=OWN_DURATION,
    example="{kind: heartbeat_loss, at_s: 2.0}",
)
read_faults, faults_of, fault_of = _LIST.read, _LIST.all_of, _LIST.one_of
