"""A trial: a stored model on the simulated arm of a station, with everything that came of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.deploy.hand_guiding import HandGuiding
from hil.deploy.low_pass import LowPass
from hil.errors import FitError, SpecError
from hil.identify.base import RobotEstimator
from hil.identify.model_file import load_model_file
from hil.identify.standstill import require_torque
from hil.payload import Payload
from hil.rest_place import place_of
from hil.spec.station import StationRobot
from hil.trial import laws, leading
from hil.trial.arm import RATE_HZ, Arm, Bench, require_simulated
from hil.trial.gains import Spring, spring_for
from hil.trial.leading import HAND_FIRMNESS, Drives, Led, lead
from hil.trial.reference import Leading, Reference, leading_for, trajectory_for
from hil.trial.tracking import Tracked, track
from hil.typing import FloatArray

FRICTION_SHARE = 0.5

SPEED_HZ = 10.0
"""Cutoff of the velocity that tells the direction of friction."""

Progress = Callable[[str], object]
"""Told what is being run."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What a model was worth to a controller.

    Attributes:
        model: Its folder.
        estimator: What fitted it.
        robot: Name in the station, and the station in words.
        serial: Of the arm it was tried on.
        fitted_on: Serial number of the arm it was fitted on; empty when nobody said.
        joint_names: Length n.
        payload: What was mounted.
        seed: Of the trajectory.
        friction_share: Of the dry friction, compensated while a hand leads.
        pd: The controller that all laws share.
        tracked: A run for each law.
        leading: The way of the hand.
        led: A run for each way of helping the hand.
        seconds: It all took.
        notes: What else one should know.
    """

    model: str
    estimator: str
    robot: str
    serial: str
    fitted_on: str
    joint_names: tuple[str, ...]
    payload: Payload
    seed: int
    friction_share: float
    pd: Spring
    tracked: tuple[Tracked, ...]
    leading: Leading
    led: tuple[Led, ...]
    seconds: float
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil try-out --json`."""
        return {
            "model": self.model,
            "estimator": self.estimator,
            "robot": self.robot,
            "serial": self.serial,
            "fitted_on": self.fitted_on,
            "joint_names": list(self.joint_names),
            "payload": {"mass_kg": self.payload.mass, "com_m": list(self.payload.com)},
            "seed": self.seed,
            "rate_hz": RATE_HZ,
            "pd": {
                "stiffness_nm_rad": self.pd.stiffness.tolist(),
                "damping_nms_rad": self.pd.damping.tolist(),
            },
            "tracking": [_tracked(run) for run in self.tracked],
            "hand": {
                "firmness": HAND_FIRMNESS,
                "friction_share": self.friction_share,
                "speed_low_pass_hz": SPEED_HZ,
                "swing_rad": self.leading.swing.tolist(),
                "led": [_led(run) for run in self.led],
            },
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


def run_trial(
    folder: Path,
    *,
    station: Path | None = None,
    robot: str | None = None,
    payload: Payload | None = None,
    seed: int = 0,
    friction_share: float = FRICTION_SHARE,
    progress: Progress = lambda text: None,
) -> Trial:
    """Try a stored model on the simulated arm of its station.

    Args:
        folder: The model.
        station: Station file; by default the one experiments here would use.
        robot: Name in the station; by default its only robot of the model's kind.
        payload: What is mounted, and told to the model.
        seed: Of the trajectory, which is never one of an experiment's.
        friction_share: Of the dry friction, compensated while a hand leads; below 1.
        progress: Is told what is being run.

    Raises:
        FitError: The model has no gravity, or nobody knows its torques.
        SpecError: The robot is no simulated one with torque control, or is another arm.
        PlanError: There is no clear motion.
        DataError: The model cannot be read.
    """
    begin = time.perf_counter()
    model = load_model_file(folder)
    require_torque(model)
    if seed < 0:
        raise SpecError(f"the seed is {seed}, but must be at least 0")
    entry, where = place_of(model, station, robot)
    name, where = _named(where, entry)
    require_simulated(name, entry)
    bench = Bench(name, entry, payload or Payload())
    progress("planning")
    reference, way = trajectory_for(bench, seed), leading_for(bench)
    pd = spring_for(model.robot_, reference.q[:: round(RATE_HZ / 20)])
    tracked, serial = _track(model, bench, reference, pd, progress)
    led, notes = _lead(model, bench, way, pd.firmer(HAND_FIRMNESS), friction_share, progress)
    known = model.training_.serial if model.training_ else ""
    if known and known != serial:
        notes.append(
            f"the model was fitted on {known}, and tried on {serial}: another individual has "
            "other masses and friction, and the errors show it"
        )
    return Trial(
        str(folder), model.estimator, where, serial, known, model.joint_names_, bench.payload,
        seed, friction_share, pd, tracked, way, led, time.perf_counter() - begin, tuple(notes),
    )  # fmt: skip


def _track(
    model: RobotEstimator, bench: Bench, reference: Reference, pd: Spring, progress: Progress
) -> tuple[tuple[Tracked, ...], str]:
    """A run for each law, and the arm's serial number."""
    with bench.arm(reference.q[0]) as arm:
        gains, serial = arm.gains, arm.serial
    runs = []
    for law, ahead in laws.feed_forwards(model, bench.payload, reference, gains):
        progress(f"tracking: {law}")
        with bench.arm(reference.q[0]) as arm:
            runs.append(track(arm, law, ahead, reference, pd))
    return tuple(runs), serial


def _lead(
    model: RobotEstimator,
    bench: Bench,
    way: Leading,
    hand: Spring,
    friction_share: float,
    progress: Progress,
) -> tuple[tuple[Led, ...], list[str]]:
    """A run for each way of helping a hand, and what was left out."""
    helped: dict[str, HandGuiding | None] = {
        leading.NOTHING: None,
        leading.GRAVITY: HandGuiding(model, bench.payload, friction_share=0.0),
    }
    notes = []
    try:
        helped[leading.FRICTION] = HandGuiding(model, bench.payload, friction_share=friction_share)
    except FitError as error:
        notes.append(f"{error.message}: a hand is helped by gravity alone")
    runs = []
    for name, guiding in helped.items():
        progress(f"led by hand: {name}")
        with bench.arm(way.start) as arm:
            drives = None if guiding is None else _in_torque(guiding, arm)
            runs.append(lead(arm, name, drives, way, hand))
    return tuple(runs), notes


def _in_torque(guiding: HandGuiding, arm: Arm) -> Drives:
    """What it gives, in N·m as the arm's own controller counts."""
    scale = arm.gains if guiding.unit == "A" else np.ones_like(arm.gains)
    # Unfiltered, wrists do not come to rest: see hil.deploy.hand_guiding.
    slow = LowPass(SPEED_HZ, RATE_HZ)
    return lambda q, qd: guiding(q, slow(qd)) * scale


def _named(where: str, robot: StationRobot) -> tuple[str, str]:
    """The robot's name, which is part of a mock's serial number, and where it is in words."""
    name, told, _ = where.partition(" of ")
    alone = robot.model.replace("@", "_")
    return (name, where) if told else (alone, f"a mock {robot.model} (no station was named)")


def _numbers(values: FloatArray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _tracked(run: Tracked) -> dict[str, Any]:
    return {
        "law": run.law,
        "rms_rad": _numbers(run.rms),
        "worst_rad": _numbers(run.worst),
        "stopped": run.stopped,
    }


def _led(run: Led) -> dict[str, Any]:
    return {
        "way": run.way,
        "rms_nm": _numbers(run.rms),
        "peak_nm": _numbers(run.peak),
        "ran_on_rad": _numbers(run.ran_on),
        "rest_after_s": run.rest_s if np.isfinite(run.rest_s) else None,
        "stopped": run.stopped,
    }
