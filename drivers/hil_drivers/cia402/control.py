"""What drives are told where the master leads the joints: torque in CST, velocity in CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.track import wrapped

FADE_S = 0.5
"""A step in the feed-forward torque (a model that is off, a mode switch) goes over this time."""

_MOST_TORQUE, _MOST_VELOCITY = (1 << 15) - 1, (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class Gains:
    """Position control by the master, per axis.

    In CST torque = feed-forward + kp·e + kd·ė, in CSV velocity = the motion's + kv·e.

    Attributes:
        kp: ‰ of rated torque per increment of position.
        kd: ‰ of rated torque per count of velocity.
        limit: Largest torque commanded [‰].
        kv: Counts of velocity per increment of position.
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    limit: tuple[float, ...]
    kv: tuple[float, ...]


class Fade:
    """Feed-forward torque, without steps where one model or mode follows the other.

    Args:
        n: Axes.
        period_s: Device time of a cycle [s].
    """

    def __init__(self, n: int, period_s: float) -> None:
        self._n, self._per_cycle = n, period_s / FADE_S
        self.end()

    def begin(self, present: Sequence[int], torque: Sequence[int]) -> None:
        """From what is commanded now to what the next motion begins with [‰]."""
        self._bias = [now - then for now, then in zip(present, torque, strict=True)]
        self._left = 1.0

    def end(self) -> None:
        """There is no step any more."""
        self._bias, self._left = [0] * self._n, 0.0

    def faded(self, torque: list[int]) -> list[int]:
        """A row's torque, with what is left of the step; goes on by a cycle."""
        if self._left <= 0.0:
            return torque
        self._left -= self._per_cycle
        share = max(self._left, 0.0)
        return [
            _within(round(value + share * bias), _MOST_TORQUE)
            for value, bias in zip(torque, self._bias, strict=True)
        ]


def velocities(
    gains: Gains, velocity: Sequence[int], shown: Sequence[int], inputs: Inputs
) -> list[int]:
    """CSV: the motion's velocity, led by the positions that are to show by now."""
    return [
        _within(ahead + round(kv * wrapped(wanted - is_at)), _MOST_VELOCITY)
        for ahead, kv, wanted, is_at in zip(velocity, gains.kv, shown, inputs.position, strict=True)
    ]


def torques(
    gains: Gains,
    torque: Sequence[int],
    position: Sequence[int],
    velocity: Sequence[int],
    inputs: Inputs,
) -> list[int]:
    """CST: feed-forward, a spring and a damper to what is to show by now."""
    return [
        _within(
            round(
                torque[i]
                + gains.kp[i] * wrapped(position[i] - inputs.position[i])
                + gains.kd[i] * (velocity[i] - inputs.velocity[i])
            ),
            gains.limit[i],
        )
        for i in range(len(torque))
    ]


def _within(value: int, limit: float) -> int:
    most = int(limit)
    return most if value > most else -most if value < -most else value
