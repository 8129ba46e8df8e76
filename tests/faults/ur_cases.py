"""The fault matrix over the wire: what a UR controller may do to a run, what has to come of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.faults.cases import Ending

DWELLS = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: dwell, waypoints: 1, approach: positive, seed: 11, dwell_s: 1.2}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
TRAJECTORY = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: fourier, trajectories: 1, fundamental_hz: 0.25, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
LOAD = "loads: [{mass_kg: 1}]\n"
SPECS = {
    "dwell": DWELLS,
    "fourier": TRAJECTORY,
    "loaded dwell": DWELLS + LOAD,
    "loaded fourier": TRAJECTORY + LOAD,
}

STEPS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "move": ("dwell", {"motion": 1, "after_s": 0.7}),
    "dwell": ("dwell", {"motion": 2, "after_s": 1.0}),
    "trajectory": ("fourier", {"motion": 2, "after_s": 0.8}),
}
"""Where something goes wrong → the program, and when; motion 1 leads to the first step."""

MOVING = ("move", "trajectory")
PROGRAMS = ("dwell", "fourier")
NONE = "no run"

SILENCE = "the driver's 0.1 s without news (its option late_s), then 0.1 s"
STANDING = "; where the arm stands, the engine's 2 s for a read that does not come back"


@dataclass(frozen=True, slots=True)
class WireEnding(Ending):
    """What has to come of a fault of the controller.

    Attributes:
        fault: As the mock controller is asked for it.
        by: Who stops the arm first: `driver`, or `controller` where no command can arrive.
        before: It is there from the beginning: no arm may move.
        loaded: For those: the spec has a load.
        arguments: For the mock.
        standing_s: In place of `stop_within_s` where the arm stands when it happens.
        standing: Whether it is tried where the arm stands, too.
        counts: What the recording of a run that goes on has to count, exactly.
    """

    fault: Mapping[str, Any] = field(default_factory=dict)
    by: str = "driver"
    before: bool = False
    loaded: bool = False
    arguments: tuple[str, ...] = ()
    standing_s: float | None = None
    standing: bool = True
    counts: Mapping[str, int] = field(default_factory=dict)


def _fails(fault: str, within_s: float = 0.1, **more: Any) -> WireEnding:
    more = {"rest_within_s": 0.6, **more}
    return WireEnding("failed", 4, within_s, fault=asked(fault), **more)


def _trips(fault: str, within_s: float, **more: Any) -> WireEnding:
    return WireEnding("tripped", 5, within_s, fault=asked(fault), rest_within_s=0.6, **more)


def _goes_on(fault: str, why: str, **counts: int) -> WireEnding:
    return WireEnding("completed", 0, None, why=why, fault=asked(fault), counts=counts)


def _never_begins(fault: str, outcome: str, exit_code: int, **more: Any) -> WireEnding:
    return WireEnding(outcome, exit_code, None, fault=asked(fault), before=True, **more)


def asked(fault: str) -> Mapping[str, Any]:
    """`kind key=value …` as the mock is asked for it."""
    kind, *keys = fault.split()
    pairs = (each.split("=") for each in keys)
    return {"kind": kind, **{key: _value(text) for key, text in pairs}}


def _value(text: str) -> str | int | float:
    """A word, a whole number (also hexadecimal), or a number."""
    if text.isalpha():
        return text
    return float(text) if "." in text else int(text, 0)


FAULTS: Mapping[str, WireEnding] = {
    "connection cut": _fails("cut for_s=2"),
    "ur-rtde's connection cut": _fails("cut only=inputs"),
    "cable out": _fails(
        "unplugged",
        0.7,
        by="controller",
        why="no command arrives: the controller's watchdog acts after 0.5 s (watchdog_hz)",
    ),
    "silence": _fails("silence", 0.2, standing_s=2.5, why=SILENCE + STANDING),
    "late packages": _fails("late by_s=1.0", 0.2, standing_s=2.5, why=SILENCE + STANDING),
    "frozen data": _trips(
        "freeze",
        0.2,
        standing_s=0.7,
        why=SILENCE + "; where the arm stands, the stale interlock's 0.5 s, which is what ends the "
        "run",
    ),
    "garbage": _fails(
        "garbage", standing=False, why="it also aborts the process in which ur-rtde is"
    ),
    "wrong length": _fails("wrong_length", standing=False),
    "protective stop": _fails("protective_stop"),
    "emergency stop": _fails("emergency_stop"),
    "safeguard stop": _fails("safeguard_stop", standing=False),
    "safety fault": _fails("safety_fault", standing=False),
    "joint too hot": _fails("overheat", standing=False, why="the controller stops at 85 °C"),
    "controller reboots": _fails(
        "reboot", by="controller", why="its brakes stop the arm; no command arrives"
    ),
    "jitter": _goes_on("jitter by_s=0.03", "0 to 30 ms late, in order: nothing is lost"),
    "lost package": _goes_on("drop", "counted", gaps=1, missing=1),
    "doubled package": _goes_on("duplicate", "counted", duplicates=1),
    "dashboard hangs": _goes_on("dashboard_hang for_s=5", "nothing is asked of it meanwhile"),
    "inputs owned": _never_begins(
        "inputs_owned", NONE, 4, why="refused before the program is uploaded"
    ),
    "payload refused": _never_begins(
        "payload_refused", "failed", 3, loaded=True, why="read back before the first motion"
    ),
    "local control": _never_begins(
        "remote_off", NONE, 4, arguments=("--model", "ur5e"), why="refused before it connects"
    ),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One field of the matrix; where the fault is there from the beginning, `step` is a program."""

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
        if self.ending.before:
            return f"loaded {self.step}" if self.ending.loaded else self.step
        return STEPS[self.step][0]

    @property
    def strikes(self) -> Mapping[str, Any]:
        """The fault with its moment, for the mock."""
        when = {"at_s": 0.0} if self.ending.before else STEPS[self.step][1]
        return {**self.ending.fault, **when}

    def __str__(self) -> str:
        return f"{self.fault} at {self.step}".replace(" ", "-")


def steps_of(ending: WireEnding) -> tuple[str, ...]:
    """Where a fault strikes; while the arm moves there is most at stake."""
    if ending.before:
        return PROGRAMS
    stands = ending.standing and ending.stop_within_s is not None
    return tuple(STEPS) if stands else MOVING
