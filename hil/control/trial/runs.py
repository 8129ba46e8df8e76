"""Every run of a trial: all laws behind one controller, all ways of helping one hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from hil.control.hand_guiding import HandGuiding
from hil.control.low_pass import LowPass
from hil.control.trial import laws, leading
from hil.control.trial.arm import RATE_HZ, Arm, Bench
from hil.control.trial.gains import Spring
from hil.control.trial.leading import Drives, Led, lead
from hil.control.trial.reference import Leading, Reference
from hil.control.trial.settings import SPEED_HZ
from hil.control.trial.tracking import Tracked, track
from hil.core import FitError, FloatArray
from hil.estimators import RobotEstimator

Progress = Callable[[str], object]
"""Told what is being run."""


def tracked_by(
    model: RobotEstimator, bench: Bench, reference: Reference, pd: Spring, progress: Progress
) -> tuple[Tracked, ...]:
    """A run for each law, all with the same controller."""
    with bench.arm(reference.q[0]) as arm:
        gains = arm.gains
    runs = []
    for law, ahead in laws.feed_forwards(model, bench.payload, reference, gains):
        progress(f"tracking: {law}")
        with bench.arm(reference.q[0]) as arm:
            runs.append(track(arm, law, ahead, reference, pd))
    return tuple(runs)


def guidings(
    model: RobotEstimator, bench: Bench, friction_share: float
) -> tuple[dict[str, HandGuiding], list[str]]:
    """What the model helps a hand with, and what was left out.

    Raises:
        FitError: The model has no gravity.
        SpecError: There can be no such share.
    """
    helped = {leading.GRAVITY: HandGuiding(model, bench.payload, friction_share=0.0)}
    try:
        helped[leading.FRICTION] = HandGuiding(model, bench.payload, friction_share=friction_share)
    except FitError as error:
        return helped, [f"{error.message}: a hand is helped by gravity alone"]
    return helped, []


def led_with(
    helped: Mapping[str, HandGuiding],
    model: RobotEstimator,
    bench: Bench,
    way: Leading,
    hand: Spring,
    progress: Progress,
) -> tuple[Led, ...]:
    """A run for each way of helping a hand, the same hand every time."""
    runs = []
    for name in (leading.NOTHING, leading.DATASHEET, *helped):
        progress(f"led by hand: {name}")
        with bench.arm(way.start) as arm:
            drives: Drives | None = None
            if name == leading.DATASHEET:
                drives = _datasheet(model, bench)
            elif name in helped:
                drives = in_torque(helped[name], arm)
            runs.append(lead(arm, name, drives, way, hand))
    return tuple(runs)


def in_torque(guiding: HandGuiding, arm: Arm) -> Drives:
    """What it gives, in N·m as the arm's own controller counts."""
    scale = arm.gains if guiding.unit == "A" else np.ones_like(arm.gains)
    # Unfiltered, wrists do not come to rest: see hil.control.hand_guiding.
    slow = LowPass(SPEED_HZ, RATE_HZ)
    return lambda q, qd: guiding(q, slow(qd)) * scale


def _datasheet(model: RobotEstimator, bench: Bench) -> Drives:
    """Gravity of the arm as its maker describes it, with the load [N·m]."""
    loaded = laws.as_made(model.robot_, bench.payload)

    def gravity(q: FloatArray, qd: FloatArray) -> FloatArray:
        held: FloatArray = loaded.gravity(q[None])[0]
        return held

    return gravity
