"""Prediction of one sample at a time, with the friction state that goes from one to the next.

Every model is fed by the same `SampleStream`; what differs is the memory beside it. Most models
have none. Friction with Dahl's state carries it along the path (`DahlMemory`), and friction at rest
follows from the last two seconds of the way into the pose (`ApproachMemory`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray
from hil.data import ARRIVAL_POINTS, ARRIVAL_STEP_S, SAMPLES_PER_DWELL, Track, arrival
from hil.estimators.friction_memory import advanced, carried_step

State = TypeVar("State")
State_co = TypeVar("State_co", covariant=True)


class Memory(Protocol[State_co]):
    """What a model keeps of the samples before the present one."""

    def after(self, q: FloatArray, qd: FloatArray) -> State_co:
        """Return the state after one more sample, position and velocity (1, n) each."""


class SampleStream(Generic[State]):
    """A model fed one sample at a time.

    Args:
        n: Number of joints.
        memory: Friction state; its path begins with the first sample.
        effort: Motion q, qd, qdd, (1, n) each, and the state of the memory → effort (1, n).
    """

    def __init__(
        self,
        n: int,
        memory: Memory[State],
        effort: Callable[[FloatArray, FloatArray, FloatArray, State], FloatArray],
    ) -> None:
        self._n, self._memory, self._effort = n, memory, effort

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,); qd of exactly 0 holds.

        Raises:
            DataError: An input is not one number per joint.
        """
        q, qd, qdd = one_sample(self._n, q, qd, qdd)
        sample: FloatArray = self._effort(q, qd, qdd, self._memory.after(q, qd))[0]
        return sample


def one_sample(n: int, *motion: FloatArray) -> tuple[FloatArray, ...]:
    """Each of (n,) as a row (1, n).

    Raises:
        DataError: One is not a number per joint.
    """
    try:
        rows = tuple(np.asarray(values, dtype=np.float64).reshape(1, -1) for values in motion)
    except (TypeError, ValueError) as error:
        raise DataError(f"a sample of a stream must be numbers: {error}") from error
    if any(row.shape[1] != n for row in rows):
        shapes = ", ".join(str(np.shape(values)) for values in motion)
        raise DataError(
            f"a sample of this stream is one number for each of {n} joints; its q, qd and qdd "
            f"have the shapes {shapes}",
            hint="give every joint of the robot that the model was fitted for",
        )
    return rows


class NoMemory:
    """The memory of a model whose prediction depends on the present sample only."""

    def after(self, q: FloatArray, qd: FloatArray) -> None:
        """Nothing is kept."""


Parts = Callable[[FloatArray, FloatArray, FloatArray], dict[str, FloatArray]]
LoadEffort = Callable[[Payload, FloatArray, FloatArray, FloatArray], FloatArray]


class MemorylessStream(SampleStream[None]):
    """Feeds single samples to a model without memory.

    Args:
        n: Number of joints.
        parts: (1, n) motion → named parts of the effort.
        load_effort: Payload and (1, n) motion → effort of the payload.
        payload: The load mounted.
    """

    def __init__(self, n: int, parts: Parts, load_effort: LoadEffort, payload: Payload) -> None:
        def effort(q: FloatArray, qd: FloatArray, qdd: FloatArray, _: None) -> FloatArray:
            whole: FloatArray = np.sum(list(parts(q, qd, qdd).values()), axis=0)
            return whole if payload.is_empty else whole + load_effort(payload, q, qd, qdd)

        super().__init__(n, NoMemory(), effort)


class DahlMemory:
    """Dahl's friction states, carried along the path.

    Args:
        length: (n,) shortest length of a state [rad].
        multiples: Lengths of the states as multiples of the shortest.
    """

    def __init__(self, length: FloatArray, multiples: Sequence[float]) -> None:
        self._lengths = {multiple: multiple * length for multiple in multiples}
        self._states = {multiple: np.zeros((1, len(length))) for multiple in multiples}
        self._last: FloatArray | None = None

    def after(self, q: FloatArray, qd: FloatArray) -> dict[float, FloatArray]:
        """Return the states (1, n) by their multiple."""
        step = carried_step(q, self._last, qd)
        # A caller may write the next sample into the same array.
        self._last = q.copy()
        self._states = {
            multiple: advanced(state, step, self._lengths[multiple])
            for multiple, state in self._states.items()
        }
        return self._states


KEPT_S = 2.0
"""A joint that came to rest longer ago than this has no known approach any more [s]."""

FORMING_S = ARRIVAL_POINTS * ARRIVAL_STEP_S + 0.1
"""Standing still for so long, the arm has the whole path into the pose behind it [s]."""

AGAIN_S = 0.04
"""While the path goes on, friction is computed again this often [s]: it takes milliseconds."""


class ApproachMemory:
    """Friction of an arm at rest, from how it came to its pose.

    It is known once the arm has stood for ten samples; before that, and in motion, it is 0.

    Args:
        friction: (1, K, 2, n) path (`hil.data.arrival`) and (1, n) positions → (1, n).
        rest_speed: Slower than this, every joint is at rest [rad/s].
        period_s: Time between samples [s].
    """

    def __init__(
        self,
        friction: Callable[[FloatArray, FloatArray], FloatArray],
        rest_speed: float,
        period_s: float,
    ) -> None:
        self._friction = friction
        self._rest_speed, self._period = rest_speed, period_s
        kept = round(KEPT_S / period_s)
        self._q: deque[FloatArray] = deque(maxlen=kept)
        self._qd: deque[FloatArray] = deque(maxlen=kept)
        self._again = max(1, round(AGAIN_S / period_s))
        self._rested = 0
        self._held: FloatArray | None = None

    def after(self, q: FloatArray, qd: FloatArray) -> FloatArray:
        """Return the friction (1, n) that holds the arm, in effort units."""
        self._q.append(q[0].copy())
        self._qd.append(qd[0].copy())
        still = float(np.max(np.abs(qd))) < self._rest_speed
        self._rested = self._rested + 1 if still else 0
        stood = self._rested - SAMPLES_PER_DWELL
        forming = stood % self._again == 0 and self._rested * self._period < FORMING_S
        if stood < 0:
            self._held = None
        elif self._held is None or forming:
            self._held = self._friction(self._path()[None], q)
        return np.zeros_like(q) if self._held is None else self._held

    def _path(self) -> FloatArray:
        t = self._period * np.arange(len(self._q), dtype=np.float64)
        track = Track(t, np.array(self._q), np.array(self._qd))
        return arrival(track, float(t[-SAMPLES_PER_DWELL]), float(t[-1]))
