"""Whether axes go where they are told, and as fast as they say: looked at in every cycle."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence

from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.track import wrapped

LATENCY = 2
"""Cycles from sending a set-point to the answer in which it is reached (see `rows`)."""

IN_A_ROW = 3
"""Cycles that an axis has to be too far away: a single answer may be a drive's hiccup."""

MEASURED_OVER_S = 0.04
LEAST_RAD_S, MOST_TIMES = 0.5, 5.0
"""Velocities contradict each other when they differ by more than the first and one is more than so
many times the other, or of other sign: a wrong unit is off by 17 and more."""


class Tracking:
    """What one cycle's answers say against what was told.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis, of position, with its sign.
        bounds_deg: Mode of operation → how far an axis may be from its set-point [deg], and the
            option that says so.
        rad_s_per_count: Per axis, of velocity, with its sign; empty where it is not measured.
    """

    def __init__(
        self,
        period_s: float,
        rad_per_increment: Sequence[float],
        bounds_deg: Mapping[int, tuple[float, str]],
        rad_s_per_count: Sequence[float] = (),
    ) -> None:
        self._scale, self._unit, self._bounds_deg = rad_per_increment, rad_s_per_count, bounds_deg
        self._bounds = {
            mode: [math.radians(deg) / abs(rad) for rad in rad_per_increment]
            for mode, (deg, _) in bounds_deg.items()
        }
        self._cycles = max(2, round(MEASURED_OVER_S / period_s))
        self._over_s = self._cycles * period_s
        self._told: deque[list[int]] = deque(maxlen=LATENCY + 1)
        self._from: list[int] | None = None
        self._sum: list[int] = []
        self.restart()

    def restart(self) -> None:
        """A phase begins: nothing of what was before counts."""
        n = len(self._scale)
        self._told.clear()
        self._away, self._contradicts = [0] * n, [0] * n
        self._begin_window(None)

    def judge(self, inputs: Inputs, targets: Sequence[int], mode: int) -> Iterator[tuple[int, str]]:
        """Axes that do not go where they are told, and why that is said.

        Args:
            inputs: Of this cycle.
            targets: Positions that were sent in it.
            mode: That the axes are in.
        """
        self._told.append(list(targets))
        if len(self._told) > LATENCY and mode in self._bounds:
            yield from self._far_away(inputs, mode)
        if self._unit:
            yield from self._contradicting(inputs)

    def _far_away(self, inputs: Inputs, mode: int) -> Iterator[tuple[int, str]]:
        told, bounds = self._told[0], self._bounds[mode]
        for axis, position in enumerate(inputs.position):
            off = abs(wrapped(told[axis] - position))
            if off <= bounds[axis] or not inputs.fresh[axis]:
                self._away[axis] = 0
                continue
            self._away[axis] += 1
            if self._away[axis] >= IN_A_ROW:
                most, option = self._bounds_deg[mode]
                degrees = math.degrees(off * abs(self._scale[axis]))
                yield (
                    axis,
                    f"is {degrees:.1f}° from its set-point, {most:.3g}° are allowed ({option})",
                )

    def _contradicting(self, inputs: Inputs) -> Iterator[tuple[int, str]]:
        """One answer per window: the mean velocity told against the way that was gone."""
        if self._from is None or not all(inputs.fresh):
            self._begin_window(inputs.position.copy() if all(inputs.fresh) else None)
            return
        self._seen += 1
        self._sum = [a + b for a, b in zip(self._sum, inputs.velocity, strict=True)]
        if self._seen < self._cycles:
            return
        for axis, start in enumerate(self._from):
            way = wrapped(inputs.position[axis] - start) * self._scale[axis]
            gone, told = way / self._over_s, self._sum[axis] / self._seen * self._unit[axis]
            self._contradicts[axis] = self._contradicts[axis] + 1 if _absurd(told, gone) else 0
            if self._contradicts[axis] >= IN_A_ROW:
                yield (
                    axis,
                    f"says that it moves at {told:.3g} rad/s (606Ch), by its positions it is "
                    f"{gone:.3g} rad/s: axes.velocity_unit is wrong, or polarity (607Eh)",
                )
        self._begin_window(inputs.position.copy())

    def _begin_window(self, position: list[int] | None) -> None:
        self._from, self._seen, self._sum = position, 0, [0] * len(self._scale)


def _absurd(told: float, gone: float) -> bool:
    if abs(told - gone) <= LEAST_RAD_S:
        return False
    small, large = sorted((abs(told), abs(gone)))
    return large > MOST_TIMES * small or told * gone < 0.0
