"""Golden vectors, and the tolerances within which an exported program must reproduce the vectors.

A `Golden` contains a motion and the predictions of the Python model for that motion, sample by
sample, without and with a load. An exported C program compares itself with golden vectors in its
self-test (`closeness`). This module runs programs for other runtimes, sample by sample with their
state fed back (`require_agreement`).
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
"""Range [rad] of the golden motion for joints without limits."""

LOAD = Payload(mass=1.5, com=(0.02, -0.03, 0.06), inertia=(0.004, 0.005, 0.003, 1e-4, -2e-4, 3e-4))
"""Payload for the second half of the golden vectors, which reveals errors of payload placement."""

AGREES = 1e-4
"""Largest permitted difference of a program's effort, as a share of each joint's largest effort."""

JITTER, SLOW = 2e-4, 0.1
"""Encoder jitter [rad or m], and share of a joint's top speed below which the jitter is added.

The jitter moves positions against the velocity; friction with memory must ignore such movements.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Golden:
    """Golden vectors with which an exported program is checked.

    Attributes:
        q, qd, qdd: (N, n) motion.
        bare: (N, n) efforts without a load.
        loaded: (N, n) efforts with the payload `LOAD`, computed anew from the initial state.
        residuals: (2, N, n) contribution of a residual network to `bare` and to `loaded`; None
            without a residual network.
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    bare: FloatArray
    loaded: FloatArray
    residuals: FloatArray | None = None


def golden_of(model: RobotEstimator, samples: int = SAMPLES) -> Golden:
    """Return the golden vectors of a fitted model, computed by the stream of the model."""
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
    """Return q (N, n) with encoder jitter, one step to and fro, around reversals and standstill."""
    way = JITTER * (-1.0) ** np.arange(len(q))[:, None]
    slow = np.abs(qd) < SLOW * np.abs(qd).max(axis=0)
    return np.asarray(q + way * slow)


def motion(robot: RobotModel, samples: int, rate_hz: float) -> tuple[FloatArray, ...]:
    """Return q, qd, qdd (N, n): sine waves within the limits, with a static interval per joint.

    Args:
        robot: Robot model, which defines the joints and their limits.
        samples: Number of samples N.
        rate_hz: Sample rate [Hz].
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
"""Largest permitted difference in double and in single precision, as a share of the effort.

The reference for the share is the largest effort of each joint.
"""

NETWORK = 1e-5
"""Largest difference of a residual network, as a share of a joint's largest correction."""

UNHEARD = 1e-4
"""Minimum of the reference for `NETWORK`, as a share of a joint's largest effort."""


@dataclass(frozen=True, slots=True, eq=False)
class Closeness:
    """Tolerances for the differences between a program and the Python model.

    Attributes:
        effort: (n,) largest permitted difference of the efforts without the residual network.
        residual: (n,) largest permitted difference of the outputs of the residual network.
        largest: (n,) largest effort.
    """

    effort: FloatArray
    residual: FloatArray
    largest: FloatArray


def closeness(program: Program, golden: Golden) -> Closeness:
    """Return the tolerances in effort units for a program that should reproduce `golden`."""
    largest = scale_of(golden.bare, golden.loaded)
    own = UNHEARD * largest
    if golden.residuals is not None:
        own = np.maximum(own, np.abs(golden.residuals).max(axis=(0, 1)))
    return Closeness(precision(program) * largest, NETWORK * own, largest)


def precision(program: Program) -> float:
    """Return `DOUBLE`, or `SINGLE` if a single-precision network yields dynamics or friction."""
    kinds = [] if program.lagrangian is None else [program.lagrangian.kind]
    if isinstance(program.friction, NetworkFriction):
        kinds.append(program.friction.kind)
    return SINGLE if "float" in kinds else DOUBLE


FAINT, NOTHING = 1e-4, 1e-9
"""Minimum of a joint's reference effort, as a share of the largest joint's effort and absolute."""

FAULT = "this is a fault of hil's export: please report it with the model folder"

Step = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
"""Program as a function of q, qd, qdd (1, n), load (1, 10)[, state (1, S)].

The program returns effort (1, n)[, state (1, S)].
"""


def load_row(load: Payload) -> FloatArray:
    """Return a payload as (1, 10): mass, centre of mass, inertia about the centre of mass."""
    return np.array([[load.mass, *load.com, *load.inertia]])


def scale_of(*wanted: FloatArray) -> FloatArray:
    """Return the reference (n,) for relative differences: the largest value of each joint.

    The largest value is taken over all passed arrays (N, n). The reference has a minimum for joints
    with almost no effort, such as the last joint of a level arm, because the efforts of such joints
    are only rounding errors of other joints.
    """
    largest: FloatArray = np.max([np.abs(one).max(axis=0) for one in wanted], axis=0)
    return np.maximum(largest, max(NOTHING, FAINT * float(largest.max())))


def largest_difference(step: Step, golden: Golden, state_size: int) -> float:
    """Return the largest effort difference over all samples, as a share of each joint's `scale_of`.

    A NaN among the efforts counts as an infinite difference.

    Args:
        step: Program to be checked, whose state is fed back.
        golden: Golden vectors of the model.
        state_size: Size S of the state; 0 for a program without memory.
    """
    worst, scale = 0.0, scale_of(golden.bare, golden.loaded)
    for load, wanted in ((Payload(), golden.bare), (LOAD, golden.loaded)):
        found = streamed(step, golden, load_row(load), state_size)
        off = np.abs(found - wanted).max(axis=0) / scale
        worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max()))
    return worst


def streamed(step: Step, golden: Golden, load: FloatArray, state_size: int) -> FloatArray:
    """Return the efforts (N, n) of a program for a golden motion and a load (1, 10).

    The state of the program is zero at the start.
    """
    state = [np.zeros((1, state_size))] if state_size else []
    found = []
    for sample in zip(golden.q, golden.qd, golden.qdd, strict=True):
        effort, *state = step([*(row[None] for row in sample), load, *state])
        found.append(effort[0])
    return np.array(found)


def require_agreement(step: Step, golden: Golden, state_size: int, what: str) -> str:
    """Return a description of the agreement of a program with the model; raise if they disagree.

    Args:
        step: Program to be checked, as in `largest_difference`.
        golden: Golden vectors of the model.
        state_size: Size S of the state; 0 for a program without memory.
        what: Name of the program for the error message, such as `the ONNX graph`.

    Raises:
        FitError: The largest difference between program and model exceeds `AGREES`.
    """
    worst = largest_difference(step, golden, state_size)
    if not worst <= AGREES:
        raise FitError(
            f"{what} does not agree with the model: largest difference {worst:.1e} of the "
            "largest effort",
            hint=FAULT,
        )
    return (
        f"read back: largest difference {worst:.1e} of a joint's largest effort, "
        f"over {2 * len(golden.q)} samples"
    )
