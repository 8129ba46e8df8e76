"""What is looked at before an arm moves, with the figures: the driver's lines of a preflight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.robot import Finding
from hil_drivers.arm import payload_finding
from hil_drivers.ur.controller import INERTIA_SINCE, Controller
from hil_drivers.ur.facts import limits_of
from hil_drivers.ur.faults import MODES, RUNTIME, SAFETY, speed_complaint
from hil_drivers.ur.options import Options
from hil_drivers.ur.rows import HARMLESS, PLAYING, RUNNING
from hil_drivers.ur.session import LEAST, Told

MODE_NAMES = {
    -1: "NO_CONTROLLER", 0: "DISCONNECTED", 1: "CONFIRM_SAFETY", 2: "BOOTING", 3: "POWER_OFF",
    4: "POWER_ON", 5: "IDLE", 6: "BACKDRIVE", 7: "RUNNING", 8: "UPDATING_FIRMWARE",
}  # fmt: skip
SAFETY_NAMES = {1: "NORMAL", 2: "REDUCED", 3: "PROTECTIVE_STOP", 4: "RECOVERY"}


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What the findings are made of.

    Attributes:
        model: The arm of the station.
        options: Of the arm.
        controller: Connected.
        told: By the dashboard, just now.
        declared: The load it was last told of; None when it was not.
        moved_by: Whether the process that armed the watchdog is there.
    """

    model: str
    options: Options
    controller: Controller
    told: Told
    declared: Payload | None
    moved_by: bool


def findings_of(looked: Looked) -> Iterator[Finding]:
    """One finding per thing that was looked at."""
    row = looked.controller.row
    yield _mode(int(row["robot_mode"]))
    yield _safety(int(row["safety_mode"]))
    yield _remote(looked.told)
    yield _software(looked.controller.receiver.version)
    yield _slider(row)
    yield _payload(looked)
    yield _joint_limits(looked)
    yield _watchdog(looked, int(row["runtime_state"]))


def _mode(mode: int) -> Finding:
    name = MODE_NAMES.get(mode, str(mode))
    hint = MODES.get(mode, ("", "see the teach pendant"))[1]
    return Finding("mode", mode == RUNNING, f"robot mode {name}", name, "RUNNING", hint)


def _safety(mode: int) -> Finding:
    name = SAFETY_NAMES.get(mode, str(mode))
    hint = SAFETY.get(mode, ("", "see the teach pendant"))[1]
    return Finding("safety", mode in HARMLESS, f"safety mode {name}", name, "NORMAL", hint)


def _remote(told: Told) -> Finding:
    if not told.remote:
        said = "this controller makes no difference between local and remote control"
        return Finding("remote-control", True, said, "not told")
    on = "true" in told.remote
    said = f"the arm is in {'remote' if on else 'local'} control"
    hint = "switch it to remote control at the teach pendant"
    return Finding("remote-control", on, said, told.remote, "true", hint)


def _software(version: tuple[int, ...]) -> Finding:
    said, least = ".".join(map(str, version)), LEAST.get(version[0], (3, 11))
    wanted = ".".join(map(str, least))
    return Finding(
        "software",
        version[0] in LEAST and tuple(version[:2]) >= least,
        f"software {said}; {wanted} or later of this generation tells what is needed",
        said,
        wanted,
        "update the controller's software",
    )


def _slider(row: np.void) -> Finding:
    share = float(row["target_speed_fraction"])
    complaints = speed_complaint(row)
    hint = complaints[0][1] if complaints else ""
    return Finding("speed-slider", not complaints, f"speed slider at {share:.0%}", share, 1.0, hint)


def _payload(looked: Looked) -> Finding:
    old = looked.controller.receiver.version[:2] < INERTIA_SINCE
    remark = "; this software takes no inertia" if old else ""
    hint = "look for a message at the teach pendant"
    return payload_finding(looked.declared, looked.controller.believed, hint, remark)


def _joint_limits(looked: Looked) -> Finding:
    """The limits that plans are held against are the stricter ones of maker and controller."""
    told = looked.controller.configured
    if told is None:
        said = f"the controller's joint limits are not known: {looked.controller.untold}"
        hint = "see whether port 30001 is open in the controller's security settings"
        return Finding("joint-limits", False, said, hint=hint)
    maker, used = limits_of(looked.model, looked.options), looked.controller.limits
    by = {
        "rad": float(max((used.q_min - maker.q_min).max(), (maker.q_max - used.q_max).max())),
        "rad/s": float((maker.qd_max - used.qd_max).max()),
        "rad/s²": float((maker.qdd_max - used.qdd_max).max()),
    }
    narrower = ", ".join(f"{value:.3f} {unit}" for unit, value in by.items() if value > 0)
    wider = told.exceeded_by(used)
    said = "joint limits used are no wider than the controller's (told on port 30001), which are "
    said += (
        f"narrower than the maker's by up to {narrower}" if narrower else "as wide as the maker's"
    )
    return Finding("joint-limits", not wider.any(), said, narrower or "0 rad")


def _watchdog(looked: Looked, runtime: int) -> Finding:
    hz = looked.options.watchdog_hz
    plays = RUNTIME.get(runtime, str(runtime))
    return Finding(
        "watchdog",
        looked.moved_by and runtime == PLAYING,
        f"watchdog armed at {hz:g} Hz in our program, which is {plays}",
        hz,
        hint="connect again",
    )
