"""What a plan's measuring samples are worth, and what the arm's motors have to give for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil.dynamics import RobotModel, base_parameters, conditioning
from hil.excitation import Motion

MOST_ROWS = 1500
"""Samples a regressor is computed from: more change the condition number in the third digit."""

EFFORT_ROWS = 10_000

Score = Callable[[FloatArray, FloatArray, FloatArray], float]


def condition_score(arm: ArmDescription, gravity: Sequence[float], *, at_rest: bool) -> Score:
    """Column-scaled condition number of the base regressor as a function of q, qd, qdd (N, n).

    Args:
        arm: The arm.
        gravity: (3,) in the base frame [m/s²].
        at_rest: Only the parameters that gravity shows count; velocities are ignored.
    """
    model = RobotModel.from_arm(arm.name, gravity=gravity)
    base = base_parameters(model, gravity_only=at_rest)

    def score(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> float:
        W = model.gravity_regressor(q) if at_rest else model.regressor(q, qd, qdd)
        if len(W) < base.rank:
            return float("inf")
        scaled = conditioning(base.reduce(W)).scaled
        return scaled if scaled < 1e12 else float("inf")

    return score


def condition_number(score: Score, measured: Sequence[Motion], rate_hz: float) -> float:
    """`score` over evenly thinned samples of the measuring motions."""
    return score(*_thinned(measured, rate_hz, MOST_ROWS))


def effort_margin(
    arm: ArmDescription,
    gravity: Sequence[float],
    loads: Sequence[Payload],
    motions: Sequence[Motion],
    rate_hz: float,
) -> float:
    """Smallest distance of a joint torque to its limit [N·m].

    Of the nominal rigid body with each load, friction left out; negative when the arm cannot.
    """
    model = RobotModel.from_arm(arm.name, gravity=gravity)
    q, qd, qdd = _thinned(motions, rate_hz, EFFORT_ROWS)
    return min(
        float(
            (arm.effort_max - np.abs(model.with_payload(load).inverse_dynamics(q, qd, qdd))).min()
        )
        for load in dict.fromkeys(loads)
    )


def _thinned(
    motions: Sequence[Motion], rate_hz: float, most_rows: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """q, qd, qdd of every k-th sample of the distinct motions, at most about `most_rows`."""
    samples = [motion.sample(rate_hz) for motion in dict.fromkeys(motions)]
    every = max(1, sum(map(len, samples)) // most_rows)
    columns = ([getattr(s, name) for s in samples] for name in ("q", "qd", "qdd"))
    q, qd, qdd = (np.concatenate(column)[::every] for column in columns)
    return q, qd, qdd
