"""The fault matrix over the wire: what a UR controller may do to a run, what has to come of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from faults.cases import Ending

PATIENT: Mapping[str, Any] = {"late_s": 0.5, "lag_s": 1.0, "watchdog_hz": 1.0}
"""Options of the driver where no time-out is at stake: a busy computer shall not end a run."""

PROMPT: Mapping[str, Any] = {**PATIENT, "late_s": 0.1}
VITAL: Mapping[str, Any] = {**PATIENT, "watchdog_hz": 2.0}

DWELLS = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: dwell, waypoints: 2, approach: positive, seed: 3, dwell_s: 1.5}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
TRAJECTORY = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: fourier, trajectories: 1, fundamental_hz: 0.1, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
LOADED = DWELLS.replace("reference:", "loads: [{mass_kg: 1}]\nreference:")
SPECS = {"dwells": DWELLS, "trajectory": TRAJECTORY, "loaded": LOADED}

STEPS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "move": ("dwells", {"motion": 1, "after_s": 0.6}),
    "dwell": ("dwells", {"motion": 2, "after_s": 1.0}),
    "trajectory": ("trajectory", {"motion": 2, "after_s": 1.0}),
}
"""Where something goes wrong → the spec, and when; motion 1 leads to the first step."""

BEFORE = "before"
"""It goes wrong before the run begins: no arm may move."""

NONE = "no run"


@dataclass(frozen=True, slots=True)
class WireEnding(Ending):
    """What has to come of a fault of the controller.

    Attributes:
        fault: As the mock controller is asked for it.
        by: Who stops the arm first: `driver`, or `controller` where no command can arrive or the
            controller needs none.
        before: It is there from the beginning.
        spec: For those, the spec.
        arguments: For the mock.
        options: Of the driver.
        standing_s: In place of `stop_within_s` where the arm stands when it happens.
        lacks: What a run that goes on may lack.
    """

    fault: Mapping[str, Any] = field(default_factory=dict)
    by: str = "driver"
    before: bool = False
    spec: str = "dwells"
    arguments: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=lambda: PATIENT)
    standing_s: float | None = None
    lacks: tuple[str, ...] = ()


def _fails(fault: str, within_s: float = 0.1, **more: Any) -> WireEnding:
    return WireEnding("failed", 4, within_s, fault=_asked(fault), **more)


def _goes_on(fault: str, *lacks: str) -> WireEnding:
    return WireEnding("completed", 0, None, fault=_asked(fault), lacks=lacks)


def _never_begins(fault: str, outcome: str, exit_code: int, **more: Any) -> WireEnding:
    return WireEnding(outcome, exit_code, None, fault=_asked(fault), before=True, **more)


def _asked(fault: str) -> Mapping[str, Any]:
    """`kind key=value …` as the mock is asked for it."""
    kind, *keys = fault.split()
    return {"kind": kind, **{key: float(v) for key, v in (each.split("=") for each in keys)}}


_SILENT: Mapping[str, Any] = {
    "options": PROMPT,
    "standing_s": 2.5,
    "why": "0.1 s of silence, then 0.1 s; where the arm stands, a read that does not come back",
}
FAULTS: Mapping[str, WireEnding] = {
    "connection cut": _fails("cut for_s=2"),
    "cable out": _fails(
        "unplugged",
        0.4,
        by="controller",
        options=VITAL,
        why="no command arrives: the controller's watchdog acts after 0.25 s",
    ),
    "silence": _fails("silence", 0.2, **_SILENT),
    "late packages": _fails("late by_s=1.0", 0.2, **_SILENT),
    "frozen data": WireEnding(
        "tripped", 5, 0.7, fault=_asked("freeze"), why="0.5 s without news is stale, then 0.1 s"
    ),
    "garbage": _fails("garbage", why="it also aborts the process in which ur-rtde is"),
    "wrong length": _fails("wrong_length"),
    "protective stop": _fails("protective_stop"),
    "emergency stop": _fails("emergency_stop"),
    "safeguard stop": _fails("safeguard_stop"),
    "safety fault": _fails("safety_fault"),
    "joint too hot": _fails("overheat", why="the controller stops at 85 °C"),
    "controller reboots": _fails("reboot", by="controller", why="its brakes stop the arm"),
    "jitter": _goes_on("jitter by_s=0.04"),
    "lost packages": _goes_on("drop", "gaps", "missing"),
    "doubled packages": _goes_on("duplicate", "duplicates"),
    "dashboard hangs": _goes_on("dashboard_hang for_s=5"),
    "inputs owned": _never_begins("inputs_owned", NONE, 4),
    "payload refused": _never_begins("payload_refused", "failed", 3, spec="loaded"),
    "local control": _never_begins("remote_off", NONE, 4, arguments=("--model", "ur5e")),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One field of the matrix."""

    step: str
    fault: str

    @property
    def ending(self) -> WireEnding:
        """What has to come of it."""
        return FAULTS[self.fault]

    @property
    def stop_within_s(self) -> float | None:
        """Wall time from the fault to the first stop."""
        standing = self.step == "dwell" and self.ending.standing_s is not None
        return self.ending.standing_s if standing else self.ending.stop_within_s

    @property
    def spec(self) -> str:
        """Name of the spec that is run."""
        return self.ending.spec if self.ending.before else STEPS[self.step][0]

    @property
    def strikes(self) -> Mapping[str, Any]:
        """The fault with its moment, for the mock."""
        when = {"at_s": 0.0} if self.ending.before else STEPS[self.step][1]
        return {**self.ending.fault, **when}

    def __str__(self) -> str:
        return f"{self.fault} at {self.step}".replace(" ", "-")


def cases() -> Iterator[Case]:
    """All fields."""
    for fault, ending in FAULTS.items():
        for step in (BEFORE,) if ending.before else STEPS:
            yield Case(step, fault)
