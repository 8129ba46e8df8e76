"""Whether a program for another runtime says what the model says, streaming as that does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.export.golden import AGREES, LOAD, Golden

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
