"""The fault matrix over CAN: what drives and their bus may do to a run, what has to come of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tests.faults.ur_cases import NONE, WireEnding, asked

DWELLS = """
hil: 1
name: matrix
robot: lab6_can
excitation:
  kind: dwell
  waypoints: 1
  approach: positive
  seed: 11
  dwell_s: 1.0
  max_velocity_deg_s: 100
  max_acceleration_deg_s2: 250
  max_jerk_deg_s3: 4000
warm_up: {duration_s: 0}
reference: {every: 0}
interlocks: [{kind: tracking_error, limit_rad: 0.5}]
"""
TRAJECTORY = """
hil: 1
name: matrix
robot: lab6_can
excitation: {kind: fourier, trajectories: 1, fundamental_hz: 0.5, harmonics: 2, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
interlocks: [{kind: tracking_error, limit_rad: 0.5}]
"""
"""The interlock is kept from being quicker than the driver, which is what is tried here."""

SPECS = {"dwell": DWELLS, "fourier": TRAJECTORY}

STEPS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "move": ("dwell", {"motion": 1, "after_s": 0.4}),
    "dwell": ("dwell", {"motion": 2, "after_s": 0.8}),
    "trajectory": ("fourier", {"motion": 2, "after_s": 0.6}),
}
"""Where something goes wrong → the program, and when; motion 1 leads to the first step."""

AFTER_S = {"move": 0.4, "dwell": 0.3, "trajectory": 0.6}
"""The same for what hil's own processes do wrong, from the beginning of the step on [s]."""

MOVING = ("move", "trajectory")
PROGRAMS = ("dwell", "fourier")

FREE: Mapping[str, Any] = {"pace": "free", "rate_hz": 250, "late_cycles": 25}
"""Options of the driver where cycles have no deadlines."""
REAL_TIME: Mapping[str, Any] = {"pace": 1, "rate_hz": 100, "late_cycles": 100}
"""In real time a busy computer has to keep up with the cycles; it may pause for a second."""
PATIENCE_S = 1.0
"""Of the mock, where time may pass by SYNC alone."""

SILENT = "26 SYNCs without an answer (option late_cycles: 25), 104 ms, then 0.1 s"
ASKS_NOTHING = "nothing is asked by SDO meanwhile"


@dataclass(frozen=True, slots=True)
class CanEnding(WireEnding):
    """What has to come of a fault of the drives, of the bus, or of our own processes.

    Attributes:
        says: What has to be in the message: who, and what by which code.
        free: Cycles have no deadlines, drives do not go on without SYNC, and stops are timed in
            device time, cycle by cycle, none of which a busy computer changes. In real time is
            what wall time is part of: our own processes, and drives that go by their own timers.
        host: It is done by the run's own process, under this name.
        doubtful: Cycles more that may be left out of the recording: an answer that comes after
            one that is missing may be that one, and then it is not used.
        proof: Another fault of the same kind is in `make test-all` already.
    """

    says: tuple[str, ...] = ()
    free: bool = False
    host: str = ""
    doubtful: int = 1
    proof: bool = False


def _fails(fault: str, *says: str, within_s: float = 0.1, **more: Any) -> CanEnding:
    return CanEnding("failed", 4, within_s, fault=asked(fault), says=says, **_resting(more))


def _counted(fault: str, *says: str, within_s: float = 0.1, **more: Any) -> CanEnding:
    return _fails(fault, *says, within_s=within_s, free=True, **more)


def _host(
    name: str, outcome: str, exit_code: int, *says: str, within_s: float, **more: Any
) -> CanEnding:
    return CanEnding(outcome, exit_code, within_s, host=name, says=says, **_resting(more))


def _resting(more: Mapping[str, Any]) -> dict[str, Any]:
    return {"rest_within_s": 0.6, **more}


def _goes_on(fault: str, why: str, *, gaps: int = 0, missing: int = 0, **more: Any) -> CanEnding:
    counts = {"gaps": gaps, "missing": missing} if gaps else {}
    more = {"why": why, "counts": counts, "free": True, **more}
    return CanEnding("completed", 0, None, fault=asked(fault), **more)


def _never_begins(fault: str, *says: str, **more: Any) -> CanEnding:
    return CanEnding(NONE, 4, None, fault=asked(fault), before=True, says=says, free=True, **more)


FAULTS: Mapping[str, CanEnding] = {
    "emergency": _counted("emergency axis=2 code=0x7305", "joint_2 (node 2)", "encoder 1 (7305h)"),
    "following error": _counted(
        "following_error axis=3", "joint_3 (node 3)", "following error (8611h)"
    ),
    "over-current": _counted(
        "overcurrent axis=1", "joint_1 (node 1)", "continuous over-current at the output (2310h)"
    ),
    "motor too hot": _counted(
        "overheat axis=4",
        "joint_4 (node 4)",
        "drive or motor too hot (4310h)",
        why="a drive fails at 110 °C",
    ),
    "set-points ignored": _counted(
        "bit12_low axis=6", "joint_6 (node 6)", "ignores set-points (bit 12 low)"
    ),
    "SYNC ignored": _counted(
        "sync_ignored axis=5", "joint_5 (node 5)", "(8700h)", within_s=0.3, why=SILENT
    ),
    "heartbeat lost": _counted(
        "heartbeat_loss axis=5",
        "joint_5 (node 5)",
        "its heartbeat is overdue",
        within_s=0.5,
        why="0.3 s after the last of them, then 0.1 s",
    ),
    "drive reboots": _counted(
        "node_reboot axis=6 for_s=0.3",
        "joint_6 (node 6)",
        within_s=0.3,
        why=SILENT + "; its own brake closes at once",
    ),
    "drive off the bus": _counted("bus_off axis=3", "joint_3 (node 3)", within_s=0.3, why=SILENT),
    "master off the bus": _fails(
        "bus_off axis=master",
        "the CAN controller of this computer is off the bus (bus-off)",
        "No axis answers",
        by="drives",
        within_s=0.4,
        why="no command arrives: drives stop by themselves after 0.1 s without SYNC, or 0.25 s "
        "without the master's heartbeat",
    ),
    "many frames lost": _counted(
        "lost_frames axis=2 frames=400",
        "joint_2 (node 2)",
        "has not answered",
        within_s=0.3,
        why=SILENT,
    ),
    "frames late": _counted(
        "late_frames axis=2 by_s=1.0",
        "joint_2 (node 2)",
        "has not answered",
        within_s=0.3,
        why=SILENT,
    ),
    "many frames too short": _counted(
        "wrong_length axis=4 frames=400", "joint_4 (node 4)", within_s=0.3, why=SILENT
    ),
    "a frame lost": _goes_on("lost_frames axis=3", "counted", gaps=1, missing=1),
    "three frames lost": _goes_on(
        "lost_frames axis=3 frames=3",
        "counted, with up to five cycles until it is clear that none of them is still to come",
        doubtful=5,
        proof=True,
        gaps=1,
        missing=2,
    ),
    "a frame too short": _goes_on(
        "wrong_length axis=4", "counted as lost", gaps=1, missing=1, proof=True
    ),
    "frames one cycle late": _goes_on(
        "late_frames axis=2 by_s=0.004",
        "counted as one lost: no frame says which SYNC it answers, so that axis is one cycle "
        "behind the others from then on",
        gaps=1,
        missing=1,
    ),
    "SDO silent": _goes_on("sdo_silent axis=2", ASKS_NOTHING, proof=True),
    "SDO aborted": _goes_on("sdo_abort axis=2", ASKS_NOTHING, proof=True),
    "mode refused": _never_begins(
        "refused_mode axis=3",
        "joint_3 (node 3)",
        "mode 8 (csp) was requested, 6061h shows 0",
        why="6061h is read before enabling",
    ),
    "mapping refused": _never_begins(
        "mapping_refused axis=5",
        "joint_5",
        "0604 0041h",
        why="written and read back before the first SYNC",
    ),
    "SDO silent from the start": _never_begins(
        "sdo_silent axis=2", "joint_2", why="drives are asked who they are"
    ),
    "SDO aborted from the start": _never_begins(
        "sdo_abort axis=4 index=0x60C2", "joint_4", why="drives are asked who they are"
    ),
    "driver killed": _host(
        "driver killed",
        "failed",
        4,
        "the driver process died (signal 9: Killed)",
        within_s=0.3,
        why="by hil, which tells the drives itself",
    ),
    "hil killed": _host(
        "kill -9",
        "interrupted",
        -9,
        within_s=0.6,
        why="by the driver's process, which sees the end of its line: braked on the way, switched "
        "off at rest",
    ),
    "Ctrl-C twice": _host(
        "SIGINT twice", "stopped", 130, within_s=0.6, why="braked on the way, switched off at rest"
    ),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One field of the matrix; where the fault is there from the beginning, `step` is a program."""

    step: str
    fault: str

    @property
    def ending(self) -> CanEnding:
        """What has to come of it."""
        return FAULTS[self.fault]

    @property
    def spec(self) -> str:
        """Text of the spec that is run."""
        return SPECS[self.step if self.ending.before else STEPS[self.step][0]]

    @property
    def cycles(self) -> Mapping[str, Any]:
        """Options of the driver."""
        return FREE if self.ending.free else REAL_TIME

    @property
    def strikes(self) -> list[Mapping[str, Any]]:
        """The fault with its moment, for the mock."""
        if self.ending.host:
            return []
        when = {"at_s": 0.0} if self.ending.before else STEPS[self.step][1]
        return [{**self.ending.fault, **when}]

    @property
    def done_by_host(self) -> Mapping[str, Any]:
        """The same, for the run's own process."""
        name = self.ending.host
        return {"at": self.step, "fault": name, "after_s": AFTER_S[self.step]} if name else {}

    def __str__(self) -> str:
        return f"{self.fault} at {self.step}".replace(" ", "-")


def steps_of(ending: CanEnding) -> tuple[str, ...]:
    """Where a fault strikes; what goes on is tried where the arm moves."""
    if ending.before:
        return PROGRAMS
    return MOVING if ending.stop_within_s is None else tuple(STEPS)
