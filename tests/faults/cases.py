"""The fault matrix: every kind of step × what may go wrong, and what has to come of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

SPEED = 4.0
"""Simulated seconds per second of wall time."""

WATCHDOG_S = 1.0
"""Of the mock controller: wall time without a client until it stops the arm by itself [s]."""

DWELLS = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: dwell, waypoints: 3, approach: positive, seed: 3, dwell_s: 0.8}
warm_up: {duration_s: 1}
reference: {every: 1}
"""
SWEEP = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: dwell, waypoints: 3, approach: positive, seed: 3, dwell_s: 0.8}
warm_up: {duration_s: 0}
reference: {every: 0}
loads: [{mass_kg: 0}, {mass_kg: 2, prompt: "Mount 2 kg"}]
weigh: {poses: 1}
"""
TRAJECTORY = """
hil: 1
name: matrix
robot: ur5
excitation: {kind: fourier, trajectories: 1, fundamental_hz: 0.05, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
"""
SPECS = {"dwells": DWELLS, "sweep": SWEEP, "trajectory": TRAJECTORY}

STEPS: Mapping[str, tuple[str, float]] = {
    "payload": ("sweep", 0.1),
    "weigh": ("sweep", 0.1),
    "warmup": ("dwells", 0.2),
    "move": ("dwells", 0.2),
    "dwell": ("dwells", 0.1),
    "reference": ("dwells", 0.1),
    "trajectory": ("trajectory", 0.6),
}
"""Kind of step → the spec that has one, and how long after its beginning something goes wrong [s].

A dwell takes 0.2 s of wall time here, so that the fault falls into it.
"""


@dataclass(frozen=True, slots=True)
class Ending:
    """What has to come of a fault.

    Attributes:
        outcome: Of the run directory.
        exit_code: Of the process; negative for the signal that killed it.
        stop_within_s: From the fault to the first stop command; None where the run goes on.
        rest_within_s: Device time from there until nothing moves.
        mock: The fault is the mock's own, of this kind.
        why: For the table: where the time allowed comes from.
    """

    outcome: str
    exit_code: int
    stop_within_s: float | None = 0.1
    mock: str = ""
    why: str = ""
    rest_within_s: float = 2.0


FAULTS: Mapping[str, Ending] = {
    "SIGINT twice": Ending("stopped", 130),
    "SIGTERM": Ending("stopped", 130),
    "kill -9": Ending("interrupted", -9, why="by the driver's process, which sees end of file"),
    "robot fault": Ending("failed", 4, mock="protective_stop"),
    "comms loss": Ending(
        "failed",
        4,
        mock="cut",
        rest_within_s=2.0 + WATCHDOG_S * SPEED,
        why="no command arrives: the controller's watchdog acts after 1 s, 4 s of this fast device",
    ),
    "frozen data": Ending(
        "tripped", 5, 0.7, mock="freeze", why="the stale interlock's 0.5 s without news, then 0.1 s"
    ),
    "hung driver": Ending(
        "failed", 4, 3.0, mock="hang", why="a read that does not come back in 1 s plus grace"
    ),
    "disk full": Ending("failed", 7),
    "slow disk": Ending("completed", 0, None, why="fsync of 0.5 s: nothing is lost, it goes on"),
    "stalled disk": Ending(
        "tripped", 5, 2.3, why="the recorder interlock's 2 s behind, then 0.1 s"
    ),
    "raising observer": Ending("completed", 0, None),
    "recorder death": Ending("failed", 7),
    "clock step": Ending("completed", 0, None, why="the host's clock jumps an hour"),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One field of the matrix."""

    step: str
    fault: str

    @property
    def ending(self) -> Ending:
        """What has to come of it."""
        return FAULTS[self.fault]

    def __str__(self) -> str:
        return f"{self.fault} at {self.step}".replace(" ", "-")


def cases() -> Iterator[Case]:
    """All fields."""
    for step in STEPS:
        for fault in FAULTS:
            yield Case(step, fault)


def at_once(case: Case) -> bool:
    """Whether a field is in `make test-all`: every fault at one kind of step, another each time."""
    turn = list(FAULTS).index(case.fault) - list(STEPS).index(case.step)
    return turn % len(STEPS) == 0
