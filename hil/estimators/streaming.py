"""Prediction of one sample at a time, with a friction state that is updated at every sample.

Every model uses the same `SampleStream`; models differ in the memory object of their stream. Most
models have no memory of earlier samples. Friction models with Dahl's state update the state along
the path (`DahlMemory`). Static friction models compute friction from the last two seconds of the
motion into the pose (`ApproachMemory`).
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
    """Interface of the memory of earlier samples that a model needs."""

    def after(self, q: FloatArray, qd: FloatArray) -> State_co:
        """Update the state with one sample, position and velocity (1, n) each; return the state."""


class SampleStream(Generic[State]):
    """Predictor that receives the motion one sample at a time.

    Args:
        n: Number of joints.
        memory: Friction state; its path begins with the first sample.
        effort: Function of q, qd, qdd, (1, n) each, and the state of the memory that returns the
            effort (1, n).
    """

    def __init__(
        self,
        n: int,
        memory: Memory[State],
        effort: Callable[[FloatArray, FloatArray, FloatArray, State], FloatArray],
    ) -> None:
        self._n, self._memory, self._effort = n, memory, effort

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the predicted effort (n,) for one sample; each input has the shape (n,).

        A velocity of exactly 0 keeps the friction state constant.

        Raises:
            DataError: An input does not have one number per joint.
        """
        q, qd, qdd = one_sample(self._n, q, qd, qdd)
        sample: FloatArray = self._effort(q, qd, qdd, self._memory.after(q, qd))[0]
        return sample


def one_sample(n: int, *motion: FloatArray) -> tuple[FloatArray, ...]:
    """Return each input of shape (n,) as a row (1, n).

    Raises:
        DataError: An input does not have one number per joint.
    """
    try:
        rows = tuple(np.asarray(values, dtype=np.float64).reshape(1, -1) for values in motion)
    except (TypeError, ValueError) as error:
        raise DataError(f"a sample of a stream must be numbers: {error}") from error
    if any(row.shape[1] != n for row in rows):
        shapes = ", ".join(str(np.shape(values)) for values in motion)
        raise DataError(
            f"a sample of this stream needs one number for each of {n} joints, but q, qd and qdd "
            f"have the shapes {shapes}",
            hint="pass a value for every joint of the robot that the model was fitted for",
        )
    return rows


class NoMemory:
    """Empty memory for models whose prediction depends only on the current sample."""

    def after(self, q: FloatArray, qd: FloatArray) -> None:
        """Return None, because no state is retained."""


Parts = Callable[[FloatArray, FloatArray, FloatArray], dict[str, FloatArray]]
LoadEffort = Callable[[Payload, FloatArray, FloatArray, FloatArray], FloatArray]


class MemorylessStream(SampleStream[None]):
    """Predictor of single samples for a model without memory.

    Args:
        n: Number of joints.
        parts: Function of the motion q, qd, qdd, (1, n) each, that returns the effort components by
            name.
        load_effort: Function of the payload and the motion that returns the payload effort.
        payload: Mounted payload.
    """

    def __init__(self, n: int, parts: Parts, load_effort: LoadEffort, payload: Payload) -> None:
        def effort(q: FloatArray, qd: FloatArray, qdd: FloatArray, _: None) -> FloatArray:
            whole: FloatArray = np.sum(list(parts(q, qd, qdd).values()), axis=0)
            return whole if payload.is_empty else whole + load_effort(payload, q, qd, qdd)

        super().__init__(n, NoMemory(), effort)


class DahlMemory:
    """States of Dahl's friction model, updated along the path.

    Args:
        length: (n,) shortest length of a state [rad].
        multiples: Lengths of the states as multiples of the shortest length.
    """

    def __init__(self, length: FloatArray, multiples: Sequence[float]) -> None:
        self._lengths = {multiple: multiple * length for multiple in multiples}
        self._states = {multiple: np.zeros((1, len(length))) for multiple in multiples}
        self._last: FloatArray | None = None

    def after(self, q: FloatArray, qd: FloatArray) -> dict[float, FloatArray]:
        """Update the states with one sample; return them, (1, n) each, by their multiple."""
        step = carried_step(q, self._last, qd)
        # The copy is necessary, because a caller may write the next sample into the same array.
        self._last = q.copy()
        self._states = {
            multiple: advanced(state, step, self._lengths[multiple])
            for multiple, state in self._states.items()
        }
        return self._states


KEPT_S = 2.0
"""Time after the motion into a pose beyond which the approach direction is unknown [s]."""

FORMING_S = ARRIVAL_POINTS * ARRIVAL_STEP_S + 0.1
"""Dwell time after which the approach path is complete [s]."""

AGAIN_S = 0.04
"""Interval between friction updates while the approach path is incomplete [s].

One friction update takes milliseconds, which is too long for every sample.
"""


class ApproachMemory:
    """Static friction computed from the motion into the pose of a stream.

    The static friction is computed after ten samples at rest; before that and during motion, it is
    0.

    Args:
        friction: Function of the approach path (1, K, 2, n), see `hil.data.arrival`, and the
            positions (1, n) that returns the friction (1, n).
        rest_speed: Speed below which every joint counts as at rest [rad/s].
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
        """Update the path with one sample and return the static friction (1, n) in effort units."""
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
