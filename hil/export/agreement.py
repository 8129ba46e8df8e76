"""Golden vectors, and how closely a program has to agree with them.

A `Golden` is a motion and what the model in Python says of it, sample by sample, without and with a
load. C compares itself in its self-test (`closeness`); programs for other runtimes are streamed
here, sample by sample with their state fed back (`require_agreement`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator
from hil.export.program import NetworkFriction, Program
from hil.networks import ResidualNetwork

RATE_HZ = 250.0
SAMPLES = 300

REACH_RAD = 2.0
"""Of joints without limits."""

LOAD = Payload(mass=1.5, com=(0.02, -0.03, 0.06), inertia=(0.004, 0.005, 0.003, 1e-4, -2e-4, 3e-4))
"""Mounted for the second half: a program that places its load wrongly is found out."""

AGREES = 1e-4
"""Largest difference of a program, as a share of each joint's largest effort."""

JITTER, SLOW = 2e-4, 0.1
"""Of an encoder [rad or m], to and fro where joints are slower than this share of their fastest.

There positions go against velocities, which memory has to be told from a way.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Golden:
    """What a program is checked with.

    Attributes:
        q, qd, qdd: (N, n).
        bare: (N, n) efforts without a load.
        loaded: (N, n) with `LOAD`, from the start again.
        residuals: (2, N, n) what of both a residual network adds; None where there is none.
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    bare: FloatArray
    loaded: FloatArray
    residuals: FloatArray | None = None


def golden_of(model: RobotEstimator, samples: int = SAMPLES) -> Golden:
    """Vectors of a fitted model, by its own stream."""
    q, qd, qdd = motion(model.robot_, samples, RATE_HZ)
    q = jittered(q, qd)
    bare, loaded = (_streamed(model, q, qd, qdd, load) for load in (Payload(), LOAD))
    residuals = None
    if isinstance(model, ResidualNetwork) and np.any(model.correction_.kept):
        inner = (_streamed(model.base_, q, qd, qdd, load) for load in (Payload(), LOAD))
        residuals = np.stack([bare, loaded]) - np.stack(list(inner))
    return Golden(q, qd, qdd, bare, loaded, residuals)


def _streamed(
    model: RobotEstimator, q: FloatArray, qd: FloatArray, qdd: FloatArray, load: Payload
) -> FloatArray:
    stream = model.stream(load)
    return np.array([stream.step(*sample) for sample in zip(q, qd, qdd, strict=True)])


def jittered(q: FloatArray, qd: FloatArray) -> FloatArray:
    """Q (N, n) as an encoder reads it around reversals and at rest: one step to and fro."""
    way = JITTER * (-1.0) ** np.arange(len(q))[:, None]
    slow = np.abs(qd) < SLOW * np.abs(qd).max(axis=0)
    return np.asarray(q + way * slow)


def motion(robot: RobotModel, samples: int, rate_hz: float) -> tuple[FloatArray, ...]:
    """q, qd, qdd (N, n): waves within the limits with reversals, and every joint at rest a while.

    Args:
        robot: Says how many joints there are and how far they go.
        samples: N.
        rate_hz: Of the samples.
    """
    t = np.arange(samples) / rate_hz
    low = np.where(np.isfinite(robot.q_min), robot.q_min, -REACH_RAD)
    high = np.where(np.isfinite(robot.q_max), robot.q_max, REACH_RAD)
    middle, reach = 0.5 * (low + high), 0.3 * np.minimum(high - low, 2 * REACH_RAD)
    j = np.arange(robot.n)
    w = 2 * np.pi * (0.4 + 0.15 * j)
    angle = w * t[:, None] + 0.7 * j
    q, qd = middle + reach * np.sin(angle), reach * w * np.cos(angle)
    qdd = -reach * w**2 * np.sin(angle)
    for joint in range(robot.n):
        start = samples // 2 + joint * (samples // 60)
        rest = slice(start, start + samples // 10)
        q[rest, joint], qd[rest, joint], qdd[rest, joint] = q[rest.start, joint], 0.0, 0.0
    return q, qd, qdd


DOUBLE, SINGLE = 1e-9, 1e-5
"""Largest difference as a share of each joint's largest effort."""

NETWORK = 1e-5
"""Of a residual network, as a share of the largest that it adds to the joint."""

UNHEARD = 1e-4
"""A residual that never comes up to this share of the effort counts as having it."""


@dataclass(frozen=True, slots=True, eq=False)
class Closeness:
    """What differences are judged by.

    Attributes:
        effort: (n,) most that efforts without the residual may differ.
        residual: (n,) most that the residual may.
        largest: (n,) largest effort.
    """

    effort: FloatArray
    residual: FloatArray
    largest: FloatArray


def closeness(program: Program, golden: Golden) -> Closeness:
    """Of a program that is to say what `golden` says, in effort units."""
    largest = scale_of(golden.bare, golden.loaded)
    own = UNHEARD * largest
    if golden.residuals is not None:
        own = np.maximum(own, np.abs(golden.residuals).max(axis=(0, 1)))
    return Closeness(precision(program) * largest, NETWORK * own, largest)


def precision(program: Program) -> float:
    """`DOUBLE`, or `SINGLE` where a network stands for the rigid body or for friction."""
    kinds = [] if program.lagrangian is None else [program.lagrangian.kind]
    if isinstance(program.friction, NetworkFriction):
        kinds.append(program.friction.kind)
    return SINGLE if "float" in kinds else DOUBLE


FAINT, NOTHING = 1e-4, 1e-9
"""A joint's largest effort counts as this share of all joints' largest, and as this, at least."""

FAULT = "this is a fault of hil's export: please report it with the model's folder"

Step = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
"""q, qd, qdd (1, n), load (1, 10)[, state (1, S)] → effort (1, n)[, state (1, S)]."""


def load_row(load: Payload) -> FloatArray:
    """(1, 10) of what is mounted: mass, centre of mass, inertia about it."""
    return np.array([[load.mass, *load.com, *load.inertia]])


def scale_of(*wanted: FloatArray) -> FloatArray:
    """(n,) what differences are shares of: each joint's largest value, over all arrays (N, n).

    A joint that has next to none, such as the last one of a level arm, counts as having a little:
    what is left there is rounding of the others.
    """
    largest: FloatArray = np.max([np.abs(one).max(axis=0) for one in wanted], axis=0)
    return np.maximum(largest, max(NOTHING, FAINT * float(largest.max())))


def largest_difference(step: Step, golden: Golden, state_size: int) -> float:
    """Over all samples, as a share of each joint's `scale_of`; NaN counts as endless.

    Args:
        step: What is looked at; its state is fed back.
        golden: What the model says.
        state_size: S; 0 without memory.
    """
    worst, scale = 0.0, scale_of(golden.bare, golden.loaded)
    for load, wanted in ((Payload(), golden.bare), (LOAD, golden.loaded)):
        found = streamed(step, golden, load_row(load), state_size)
        off = np.abs(found - wanted).max(axis=0) / scale
        worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max()))
    return worst


def streamed(step: Step, golden: Golden, load: FloatArray, state_size: int) -> FloatArray:
    """(N, n) efforts of a golden motion from the start of the state, with a load (1, 10)."""
    state = [np.zeros((1, state_size))] if state_size else []
    found = []
    for sample in zip(golden.q, golden.qd, golden.qdd, strict=True):
        effort, *state = step([*(row[None] for row in sample), load, *state])
        found.append(effort[0])
    return np.array(found)


def require_agreement(step: Step, golden: Golden, state_size: int, what: str) -> str:
    """How well they agree, in words.

    Args:
        step: See `largest_difference`.
        golden: There, too.
        state_size: And there.
        what: Is told of, such as `the ONNX graph`.

    Raises:
        FitError: They do not.
    """
    worst = largest_difference(step, golden, state_size)
    if not worst <= AGREES:
        raise FitError(
            f"{what} does not agree with the model: off by {worst:.1e} of the largest effort",
            hint=FAULT,
        )
    return (
        f"read back: largest difference {worst:.1e} of a joint's largest effort, "
        f"over {2 * len(golden.q)} samples"
    )
