"""Whether a program for another runtime says what the model says, streaming as that does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hil.deploy.export.golden import AGREES, LOAD, Golden
from hil.errors import FitError
from hil.payload import Payload
from hil.typing import FloatArray

Step = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
"""q, qd, qdd (1, n), load (1, 10)[, state (1, S)] → effort (1, n)[, state (1, S)]."""


def load_row(load: Payload) -> FloatArray:
    """(1, 10) of what is mounted: mass, centre of mass, inertia about it."""
    return np.array([[load.mass, *load.com, *load.inertia]])


def largest_difference(step: Step, golden: Golden, state_size: int) -> float:
    """Over all samples, as a share of each joint's largest effort; NaN counts as endless.

    Args:
        step: What is looked at; its state is fed back.
        golden: What the model says.
        state_size: S; 0 without memory.
    """
    worst = 0.0
    for load, wanted in ((Payload(), golden.bare), (LOAD, golden.loaded)):
        found = streamed(step, golden, load_row(load), state_size)
        largest = np.maximum(np.abs(wanted).max(axis=0), np.finfo(np.float64).tiny)
        off = np.abs(found - wanted).max(axis=0) / largest
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
            hint="this is a fault of hil's export: please report it with the model's folder",
        )
    return (
        f"read back: largest difference {worst:.1e} of a joint's largest effort, "
        f"over {2 * len(golden.q)} samples"
    )
