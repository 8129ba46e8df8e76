"""Does a network for what physics leaves help? Whole trajectories it was not fitted to say so.

A model has an easier life on its training data than anywhere else. A network that learns from
those residuals, or bands that are calibrated on them, would take the model to be better than it
is. So the trajectories are dealt into folds, and each fold is predicted by a model of the others
(`Physics`). Networks learn from what is left (`Learnt`, made by `residual_training.learn`), and
`Judged` says which joints keep theirs: a network that does not lower the error of a joint on
left-out trajectories is dropped for that joint (`select`): what physics leaves of it is noise, or
nothing that other motions share. Corrections are judged as predictions give them, within their
limits (`Correction`).

Nothing was fitted to the rows that judge, but they chose the epoch at which a network stopped: what
they say of it is a little too good.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset, group_of, groups, has_sample_split, rows_to_fit
from hil.estimators import RobotEstimator, SpeedBands, student_quantile, with_prefix, without_prefix
from hil.networks.residual_data import Motions, ResidualSettings, in_motion, trajectory_numbers
from hil.networks.residual_tcn import TrainedTcn, require_finite_arrays
from hil.networks.training import Curves

NO_FOLD = -1


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """A fitted base model, and what models like it say of rows they have not seen.

    Attributes:
        model: Fitted to everything that may be learned from.
        predicted: (N, n) effort of every row by a model of the other folds; by `model` itself in
            rows without a fold.
        valid: (N,) rows for which they stand by their prediction in every joint.
        fold: (N,) number of the fold; −1 where the rows belong to none.
    """

    model: RobotEstimator
    predicted: FloatArray
    valid: BoolArray
    fold: IntArray


def physics_of(
    dataset: Dataset,
    model: RobotEstimator,
    folds: int,
    seed: int,
    fit: Callable[[Dataset, int], RobotEstimator],
) -> Physics:
    """Predict every row by a model like the fitted one that has not seen its trajectory.

    Args:
        dataset: All rows; those that are judged are predicted, never learned from.
        model: Fitted to everything that may be learned from.
        folds: How many; with 1 the model itself predicts every row.
        seed: Of the deal.
        fit: A fresh model of its kind, fitted to a dataset without the fold of this number.
    """
    fold = fold_of_rows(dataset, folds, seed)
    prediction = model.predict(dataset)
    predicted, valid = np.array(prediction.effort), np.all(prediction.valid, axis=1)
    series = dataset.series_index()
    for number in range(int(fold.max(initial=NO_FOLD)) + 1):
        held = fold == number
        others = np.setdiff1d(np.arange(len(dataset.conditions)), np.unique(series[held]))
        left_out = dataset.take(np.unique(series[held]))
        told = fit(dataset.take(others), number).predict(left_out)
        predicted[held] = told.effort
        valid[held] = np.all(told.valid, axis=1)
    return Physics(model, predicted, valid & np.all(np.isfinite(predicted), axis=1), fold)


def fold_of_rows(dataset: Dataset, folds: int, seed: int) -> IntArray:
    """(N,) fold of every row: whole trajectories, all their loads together.

    Without at least two trajectories there are no folds. Nor are there any where a study tears
    trajectories row by row: a row's neighbours are then learned from in any case.
    """
    fold = np.full(len(dataset), NO_FOLD)
    if has_sample_split(dataset):
        return fold
    wanted = rows_to_fit(dataset)
    learned = [i for i, (_, rows) in enumerate(dataset.slices()) if np.any(wanted[rows])]
    fitted = dataset.take(learned)
    dealt = groups(fitted, "trajectory")
    count = min(folds, len(dealt))
    if count < 2:
        return fold
    order = np.random.default_rng(seed).permutation(len(dealt))
    number = {dealt[g]: k % count for k, g in enumerate(order)}
    for condition, rows in dataset.slices():
        group = group_of(condition, "trajectory")
        if group in number and np.any(wanted[rows]):
            fold[rows] = number[group]
    return fold


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """Trained networks, and what each said of rows it had not learned from.

    Attributes:
        networks: One per fold, or one.
        correction: (N, n) what they add to rows they were stopped by, in effort units.
        judged: (N,) these rows.
        used: (N,) rows that any of them learned from or was stopped by.
        curves: How each training went.
    """

    networks: tuple[TrainedTcn, ...]
    correction: FloatArray
    judged: BoolArray
    used: BoolArray
    curves: tuple[Curves, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The verdict of left-out rows.

    Attributes:
        selection: Which joints keep their network.
        correction: What predictions are corrected by: where it is kept, and how large at most.
        bands: From errors on measured effort, as recorded.
        coverage: What bands made without them hold of left-out trajectories; empty where there
            is one only.
        sigma: (n,) root-mean-square error on measured effort.
    """

    selection: Selection
    correction: Correction
    bands: SpeedBands
    coverage: dict[str, Any]
    sigma: FloatArray

    @staticmethod
    def of(
        data: Dataset, physics: Physics, learnt: Learnt, margin: float, coverage: float
    ) -> Judged:
        """Judge on the rows that networks were stopped by.

        Args:
            data: Prepared.
            physics: Predictions of models that had not seen the rows, where there are folds.
            learnt: Networks and their corrections.
            margin: See `select`.
            coverage: Of the bands.
        """
        rows = learnt.judged
        left = (data["effort_f"] - physics.predicted)[rows]
        said, blocks = learnt.correction[rows], trajectory_numbers(data)[rows]
        limit = np.max(np.abs(left), axis=0)
        kept = np.ones(len(limit), dtype=bool)
        everywhere = Correction(learnt.networks[0].settings, learnt.networks, kept, limit)
        selection = select(left, left - everywhere.bounded(said), blocks, margin)
        correction = replace(everywhere, kept=selection.kept)
        predicted = physics.predicted[rows] + correction.bounded(said)
        errors, speeds = data["effort"][rows] - predicted, data["qd_f"][rows]
        # What is left out together to try bands: folds, or trajectories where there are none.
        fold = physics.fold[rows]
        parts = fold if len(np.unique(fold)) > 1 else blocks
        return Judged(
            selection,
            correction,
            SpeedBands.calibrate(errors, speeds, blocks, coverage),
            _coverage(errors, speeds, blocks, parts, coverage),
            np.sqrt(np.mean(errors**2, axis=0)),
        )


def _coverage(
    errors: FloatArray, speeds: FloatArray, blocks: IntArray, parts: IntArray, coverage: float
) -> dict[str, Any]:
    """Bands of the other parts, tried on each; shares are means over the parts."""
    found = []
    for part in np.unique(parts):
        out: BoolArray = parts == part
        if np.all(out):
            return {}
        bands = SpeedBands.calibrate(errors[~out], speeds[~out], blocks[~out], coverage)
        found.append(bands.coverage(errors[out], speeds[out], blocks[out]))
    return {
        "asked": coverage,
        "share": np.mean([one.share for one in found], axis=0).tolist(),
        "worst_trajectory": np.min([one.worst for one in found], axis=0).tolist(),
        "trajectories": int(sum(one.trajectories for one in found)),
    }


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Which joints keep their network, and the errors that decided it.

    Attributes:
        kept: (n,) true where predictions are corrected.
        without, corrected: (n,) RMSE on left-out rows without and with the network, in effort
            units.
        better: (n,) share of the left-out trajectories on which it helps.
        margin: Share by which it had to lower the error.
    """

    kept: BoolArray
    without: FloatArray
    corrected: FloatArray
    better: FloatArray
    margin: float

    def facts(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """One entry per joint, for `model.json`."""
        return [
            {
                "joint": name,
                "kept": bool(self.kept[j]),
                "without": float(self.without[j]),
                "with": float(self.corrected[j]),
                "better_on": float(self.better[j]),
            }
            for j, name in enumerate(joint_names)
        ]

    @staticmethod
    def from_facts(facts: Sequence[Mapping[str, Any]], margin: float) -> Selection:
        """Inverse of `facts`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or no number.
        """
        without, corrected, better = (
            np.array([float(one[key]) for one in facts]) for key in ("without", "with", "better_on")
        )
        kept = np.array([bool(one["kept"]) for one in facts])
        return Selection(kept, without, corrected, better, margin)

    def notes(
        self, joint_names: Sequence[str], unit: str, rows: str = "left-out trajectories"
    ) -> tuple[str, ...]:
        """What people should know: where the network was dropped, and what it is worth.

        Args:
            joint_names: n of them.
            unit: Of the errors.
            rows: What they are of.
        """
        notes = []
        asked = f"; at least {100 * self.margin:g} % was asked, on nearly all of them"
        for word, chosen, why in (("kept", self.kept, ""), ("dropped", ~self.kept, asked)):
            if np.any(chosen):
                joints = ", ".join(self._joint(int(j), joint_names) for j in np.flatnonzero(chosen))
                notes.append(f"residual network {word} for {joints} {unit} on {rows}{why}")
        return tuple(notes)

    def _joint(self, j: int, names: Sequence[str]) -> str:
        return f"{names[j]} ({self.without[j]:.3g} → {self.corrected[j]:.3g})"


KEPT, LIMIT = "kept", "limit"

SURE = 0.9
"""Share of such choices in which the mean over all trajectories does gain."""

TINY = 1e-300


def select(
    without: FloatArray, corrected: FloatArray, blocks: IntArray, margin: float
) -> Selection:
    """Keep a joint's network if it lowers the error on rows it has not learned from.

    It has to lower it by `margin` over all of them, and so evenly that other trajectories can be
    expected to gain: the upper end of the one-sided 90 % interval of the mean logarithm of the
    ratio per trajectory (Student's t) is below 0. One trajectory says nothing of others, so it
    keeps none. With a margin of 0 nobody asks how sure it is.

    Args:
        without: (N, n) errors of physics alone, by models that had not seen these rows.
        corrected: (N, n) with the network, likewise.
        blocks: (N,) number of the trajectory of every row.
        margin: Share of the error, from 0.
    """
    before, after = _root_mean_square(without), _root_mean_square(corrected)
    gains = np.array(
        [_log_ratio(corrected[blocks == b], without[blocks == b]) for b in np.unique(blocks)]
    )
    kept = after < (1.0 - margin) * before
    if margin > 0.0:
        kept &= _highest_mean(gains) < 0.0
    return Selection(kept, before, after, np.mean(gains < 0.0, axis=0), margin)


def _root_mean_square(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def _log_ratio(corrected: FloatArray, without: FloatArray) -> FloatArray:
    after, before = (np.maximum(_root_mean_square(e), TINY) for e in (corrected, without))
    return np.asarray(np.log(after / before))


def _highest_mean(gains: FloatArray) -> FloatArray:
    """(n,) upper end of the interval of the mean of (B, n); infinite for a single one."""
    count = len(gains)
    if count < 2:
        return np.full(gains.shape[1], np.inf)
    error = np.std(gains, axis=0, ddof=1) / np.sqrt(count)
    return np.asarray(np.mean(gains, axis=0) + student_quantile(SURE, count - 1) * error)


NETWORK = "network{}."
"""Arrays of the network with that number, from 1, begin with it."""

NUMBERED = re.compile(r"network(\d+)\.")


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The mean of the networks.

    Attributes:
        settings: Of every network.
        networks: At least one, even where no joint keeps it.
        kept: (n,) joints that are corrected.
        limit: (n,) largest correction, in effort units: the largest residual there was to learn.
            Loads and motions that no training has seen can make a network say anything.
    """

    settings: ResidualSettings
    networks: tuple[TrainedTcn, ...]
    kept: BoolArray
    limit: FloatArray

    def predict(self, data: Dataset, base: FloatArray) -> FloatArray:
        """(N, n) for prepared data, 0 at rest.

        Raises:
            DataError: The torque to be heard is missing, or samples come at another rate.
        """
        moving = in_motion(data)
        if not np.any(moving) or not np.any(self.kept):
            return np.zeros_like(base)
        motions = Motions.of(data, base, self.settings)
        mean = np.mean([network.predict(motions) for network in self.networks], axis=0)
        return np.where(moving[:, None], self.bounded(mean), 0.0)

    def bounded(self, mean: FloatArray) -> FloatArray:
        """(…, n) the networks' mean within its limits, 0 for joints without network."""
        return np.where(self.kept, np.clip(mean, -self.limit, self.limit), 0.0)

    def to_arrays(self) -> dict[str, FloatArray]:
        """For a model file; the settings go beside them."""
        arrays = {KEPT: self.kept.astype(np.float64), LIMIT: self.limit}
        for number, network in enumerate(self.networks, start=1):
            arrays |= with_prefix(NETWORK.format(number), network.to_arrays())
        return arrays

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: dict[str, Any], networks: int
    ) -> Correction:
        """Inverse of `to_arrays`.

        Raises:
            KeyError, ValueError, DataError: Something is missing or garbled.
        """
        stored = {int(named[1]) for name in arrays if (named := NUMBERED.match(name))}
        if not stored or networks != len(stored) or networks != max(stored) or min(stored) < 1:
            raise ValueError(f"networks: {networks} where those stored are {sorted(stored)}")
        found = [
            _network(without_prefix(NETWORK.format(k + 1), arrays), settings)
            for k in range(networks)
        ]
        kept, limit = (np.asarray(arrays[name], dtype=np.float64) for name in (KEPT, LIMIT))
        if not np.all(np.isin(kept, (0.0, 1.0))) or not np.all(np.isfinite(limit) & (limit >= 0)):
            raise ValueError(f"{KEPT}, {LIMIT}: {kept.tolist()!s:.60}, {limit.tolist()!s:.60}")
        if not all(network.n == len(kept) == len(limit) for network in found):
            raise ValueError(f"{KEPT}: {len(kept)} joints")
        given = ResidualSettings.given(settings)
        return Correction(given, tuple(found), kept == 1.0, limit)


def _network(arrays: dict[str, FloatArray], settings: dict[str, Any]) -> TrainedTcn:
    # Without slow and fast parts there is no frequency between them.
    require_finite_arrays({name: a for name, a in arrays.items() if name != "f_cut_hz"})
    return TrainedTcn.from_arrays(arrays, settings)
