"""How a model with friction that remembers is learnt, step by step.

1. Rigid body with the core of friction; the torque through every gear follows.
2. Shapes of each joint's friction (lengths, Stribeck speeds, exponents) by variable projection.
3. The columns of all lists of groups beside the rigid body, compressed per trajectory; a list and a
   penalty per joint by trajectories left out.
4. All coefficients at once, then links that can exist.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Conditions, Dataset, FilterSettings, kept_rows, rows_to_fit
from hil.dynamics import BaseParameters, RobotModel
from hil.estimators.base import payload_torque
from hil.estimators.friction.library import CORE, Columns
from hil.estimators.friction.memory import path_steps
from hil.estimators.friction.motion import Shapes
from hil.estimators.friction.observed import Block, Observed, folds_of, observe
from hil.estimators.friction.series import motions, smoothed
from hil.estimators.friction.shapes import Part, Through
from hil.estimators.friction.solve import solve

ROWS_PER_CUTOFF = 8.0
"""A fit keeps so many rows per period of the effort's cut-off: more say nothing new."""


@dataclass(eq=False)
class Training:
    """Prepared data and all that is computed from them once.

    Attributes:
        data: Prepared dataset.
        settings: Its filters.
        Y: (N, n, b) base regressor.
        load: (N, n) torque of declared loads [N·m].
        target: (N, n) filtered torque without them [N·m].
        steps: (N, n) path [rad].
        fold: (N,) fold of every row.
        whole: Whether folds are whole trajectories.
        kept: (N,) rows that are fitted.
    """

    data: Dataset
    settings: FilterSettings
    Y: FloatArray
    load: FloatArray
    target: FloatArray
    steps: FloatArray
    fold: IntArray
    whole: bool
    kept: BoolArray

    @staticmethod
    def of(
        data: Dataset,
        settings: FilterSettings,
        robot: RobotModel,
        base: BaseParameters,
        scale: FloatArray,
    ) -> Training:
        """From prepared data of a robot whose efforts make `scale` (n,) torque per unit."""
        motion = tuple(data[name] for name in ("q_f", "qd_f", "qdd_f"))
        load = payload_torque(robot, data, *motion)
        Y = base.regressor(robot, *motion).reshape(*load.shape, base.rank)
        fold, whole = folds_of(data)
        target = data["effort_f"] * scale - load
        kept = rows_kept(data, settings) & rows_to_fit(data)
        return Training(data, settings, Y, load, target, path_steps(data), fold, whole, kept)

    def observed(
        self, groups: Mapping[str, Columns], rigid: FloatArray | None, shapes: Shapes
    ) -> Observed:
        """Compressed observations with these groups' columns.

        Args:
            groups: By name.
            rigid: (b,) base parameters for the torque through the gears; None for loads alone.
            shapes: Of the friction.
        """
        slices: dict[str, slice] = {}
        return observe(self._blocks(groups, self.transmitted(rigid), shapes, slices),
                       slices, self.Y.shape[2])  # fmt: skip

    def transmitted(self, rigid: FloatArray | None) -> FloatArray:
        """(N, n) torque through the gears [N·m]."""
        return self.load if rigid is None else self.Y @ rigid + self.load

    def load_share(self, rigid: FloatArray) -> FloatArray:
        """(n,) torque through each gear over what the rigid body leaves, on kept rows, RMS."""
        Y, target, load = self.Y[self.kept], self.target[self.kept], self.load[self.kept]
        transmitted = np.mean((Y @ rigid + load) ** 2, axis=0)
        left = np.mean((target - Y @ rigid) ** 2, axis=0)
        return np.asarray(np.sqrt(transmitted / np.maximum(left, 1e-300)))

    def rest(self, rigid: FloatArray, shapes: Shapes) -> list[Part]:
        """Per series its motion, what the rigid body leaves on kept rows, and its filter."""
        parts = []
        transmitted = self.transmitted(rigid)
        for condition, rows, motion in motions(self.data, self.steps, transmitted, shapes):
            kept = self.kept[rows]
            left = (self.target[rows] - self.Y[rows] @ rigid)[kept]
            through = _through(condition, self.data["t"][rows], self.settings, kept)
            parts.append((motion, left, through))
        return parts

    def _blocks(
        self,
        groups: Mapping[str, Columns],
        transmitted: FloatArray,
        shapes: Shapes,
        slices: dict[str, slice],
    ) -> Iterator[Block]:
        for condition, rows, motion in motions(self.data, self.steps, transmitted, shapes):
            made = {name: columns(motion) for name, columns in groups.items()}
            start = 0
            for name, columns in made.items():
                slices[name] = slice(start, start + len(columns))
                start += len(columns)
            F = np.stack([column for columns in made.values() for column in columns], axis=2)
            kept = self.kept[rows]
            F = _through(condition, self.data["t"][rows], self.settings, kept)(F)
            fold, Y, target = self.fold[rows][kept], self.Y[rows][kept], self.target[rows][kept]
            for number in np.unique(fold):
                own = fold == number
                yield int(number), F[own], Y[own], target[own]


def rigid_of(
    training: Training,
    groups: Mapping[str, Columns],
    rigid: FloatArray | None,
    shapes: Shapes,
) -> FloatArray:
    """(b,) base parameters with all of these friction groups in every joint."""
    observed = training.observed(groups, rigid, shapes)
    return solve(observed, [tuple(groups)] * observed.joints).rigid


def rows_kept(data: Dataset, settings: FilterSettings) -> BoolArray:
    """(N,) which rows a fit uses: what the settings say, else enough for the effort's cut-off."""
    if settings.thins:
        return kept_rows(data, settings)
    out = np.zeros(len(data), dtype=bool)
    for _, rows in data.slices():
        out[rows][:: _stride(data["t"][rows], settings)] = True
    return out


def _stride(t: FloatArray, settings: FilterSettings) -> int:
    if len(t) < 2:
        return 1
    rate = (len(t) - 1) / (t[-1] - t[0])
    cutoff = settings.effort * (0.5 * rate if settings.unit == "nyquist" else 1.0)
    return max(1, int(rate / (ROWS_PER_CUTOFF * cutoff)))


def _through(
    condition: Conditions, t: FloatArray, settings: FilterSettings, kept: BoolArray
) -> Through:
    """The effort's filter over one series, and the rows that are kept of it."""

    def through(values: FloatArray) -> FloatArray:
        return smoothed(values, condition, t, settings)[kept]

    return through


def core_groups(groups: Mapping[str, Columns], names: Sequence[str]) -> dict[str, Columns]:
    """Some groups of a library, the core first."""
    return {name: groups[name] for name in (CORE, *names)}
