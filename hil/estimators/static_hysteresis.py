"""Gravity at standstill with a friction state that is carried through the program.

How far a joint slid back when it stopped is in the recording, a tenth of a millirad of it, and
says how much of its friction is left. Columns of friction that follow the measured path
(`hil.estimators.rest_friction`) are fitted together with gravity; a linear correction by the paths,
its strength chosen by holding out poses of the *training* data, takes up what their form misses.
Where memory does not help on such poses, as without any slide back, it is left out.
The current of the pose that is predicted is nowhere among the inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.data import Dataset
from hil.estimators.dwell_rows import pose_numbers
from hil.estimators.least_squares import GroupedRidge, pose_folds
from hil.estimators.parameters import flag, number
from hil.estimators.rest_friction import Rest, correction_features, drive_terms, memory_terms
from hil.estimators.static_coulomb import StaticCoulomb
from hil.estimators.static_friction import FIRST_TERMS, StaticFriction

LENGTHS_RAD = (0.7e-4, 1.4e-4, 2.8e-4, 5.6e-4)
"""From a third of what the finest encoders of arms resolve to what gears give way by."""

_ARRAYS = ("mean", "scale", "weights", "leverage")


class StaticHysteresis(StaticFriction):
    """Gravity, offset, friction with memory, load and temperature, and a learnt correction.

    Args:
        lengths_rad: Lengths of Dahl's states [rad].
        gear_ratio: Motor turns per joint turn, for the ripple of the gear at once and twice a
            motor turn; None leaves it out.
        correction: Whether to try the columns on poses held out of the training, and correct by
            the paths what they leave there; False keeps the columns as they are.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.

    Attributes:
        penalty_: (n,) of the correction.
        sigma_: (n,) deviation on poses that the correction had not seen, in effort units.
    """

    estimator: ClassVar[str] = "static-hysteresis"

    _corrections: tuple[GroupedRidge, ...] = ()

    def __init__(
        self,
        *,
        lengths_rad: Sequence[float] = LENGTHS_RAD,
        gear_ratio: float | None = None,
        correction: bool = True,
        rest_speed: float = 0.01,
    ) -> None:
        self.lengths_rad = _lengths(lengths_rad)
        self.gear_ratio = gear_ratio
        if gear_ratio is not None:
            self.gear_ratio = number("gear_ratio", gear_ratio, above=0.0)
        self.correction = flag("correction", correction)
        self.rest_speed = number("rest_speed", rest_speed, above=0.0)

    def _learn(self, rows: Dataset) -> None:
        self._corrections, self.penalty_ = (), np.empty(0)
        if not self.correction:
            return
        groups = pose_numbers(rows)
        left = self._out_of_pose(rows, groups)
        if left is None:
            return self._leave_memory_out(rows)
        features = correction_features(self.rest(rows))
        self._corrections = tuple(
            GroupedRidge.fit(features[j], left[:, j], groups) for j in range(rows.n_joints)
        )
        self.penalty_ = np.array([one.penalty for one in self._corrections])
        unseen = np.stack([one.residual for one in self._corrections])
        self.sigma_ = np.sqrt(np.mean(unseen**2, axis=1))

    def _out_of_pose(self, rows: Dataset, groups: IntArray) -> FloatArray | None:
        """(D, n) effort less what a fit without the pose predicts for it.

        None when friction with memory does worse on poses it has not seen than one level of
        friction, or when there are too few poses to find out.
        """
        plain, own = StaticCoulomb(rest_speed=self.rest_speed), self._uncorrected()
        left = {model.estimator: np.empty_like(rows["effort"]) for model in (plain, own)}
        for rest, out in pose_folds(groups):
            seen, unseen = rows.take(np.flatnonzero(rest)), rows.take(np.flatnonzero(out))
            for model in (plain, own):
                try:
                    model.fit(seen, self.robot_)
                except FitError:
                    return None
                left[model.estimator][out] = unseen["effort"] - model.predict(unseen).effort
        squares = [np.mean(values**2, axis=0) for values in left.values()]
        better = float(np.mean(np.log(squares[1] / np.maximum(squares[0], 1e-300)))) < 0.0
        return left[self.estimator] if better else None

    def _uncorrected(self) -> StaticHysteresis:
        return StaticHysteresis(**{**self.get_params(), "correction": False})

    def _leave_memory_out(self, rows: Dataset) -> None:
        """Be `static-coulomb`, and say so."""
        self._choose_terms(rows, only=FIRST_TERMS)
        self._solve(rows, weighted=True)
        told = (
            "friction with memory is left out: on poses held out of the training it predicted no "
            "better than one level of friction, or there are too few poses to tell"
        )
        self.notes_ = (*self.notes_, told)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """As of every linear model, and the corrections."""
        own = {
            f"correction_{name}": np.stack([getattr(one, name) for one in self._corrections])
            for name in (_ARRAYS if self._corrections else ())
        }
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """As of every linear model, and the penalties of the corrections."""
        penalties = [one.penalty for one in self._corrections]
        return super().fitted_facts() | {"correction_penalty": penalties}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        penalties = [float(penalty) for penalty in facts["correction_penalty"]]
        self.penalty_ = np.array(penalties)
        kept = {name: arrays[f"correction_{name}"] for name in (_ARRAYS if penalties else ())}
        self._corrections = tuple(
            GroupedRidge(
                **{name: array[j] for name, array in kept.items()},
                penalty=penalty,
                residual=np.empty(0),
            )
            for j, penalty in enumerate(penalties)
        )

    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        return memory_terms(rest, self.lengths_rad)

    def _drive_terms(self, q: FloatArray, load: FloatArray) -> dict[str, FloatArray]:
        return drive_terms(q, load, self.gear_ratio)

    def _dry(self) -> tuple[str, ...]:
        return ("coulomb", *(f"memory{k + 1}" for k in range(len(self.lengths_rad))))

    def _friction(self, rows: Dataset) -> tuple[FloatArray, FloatArray, BoolArray]:
        friction, deviation, known = super()._friction(rows)
        if not self._corrections:
            return friction, deviation, known
        features = correction_features(self.rest(rows))
        pairs = list(zip(self._corrections, features, strict=True))
        corrected = friction + np.stack([one.predict(X) for one, X in pairs], axis=1)
        spread = np.stack([1.0 + one.leverages(X) for one, X in pairs], axis=1)
        return np.where(known, corrected, friction), deviation * np.sqrt(spread), known


def _lengths(lengths_rad: Any) -> tuple[float, ...]:
    if isinstance(lengths_rad, str) or not isinstance(lengths_rad, Sequence) or not lengths_rad:
        raise SpecError(f"lengths_rad is {lengths_rad!r}, but must be a list of lengths")
    return tuple(number("lengths_rad", length, above=0.0) for length in lengths_rad)
