"""Selection of the joints whose residual network is used, by held-out trajectories.

The error of a model is lower on its training data than on other data. Networks that are trained on
residuals of training data, or bands that are calibrated on such residuals, would overestimate the
accuracy of the model. Therefore the trajectories are distributed over folds, and each fold is
predicted by a model fitted to the other folds (`Physics`). Networks learn the residuals of the fold
predictions (`Learnt`, created by `residual_training.learn`), and `Judged` determines which joints
use their network. `select` rejects a network that does not lower the error of its joint on held-out
trajectories. A network cannot lower the error if the residual of the physics is noise, or does not
generalise to other motions. The evaluation uses the corrections after clipping them to their
limits, as in predictions (`Correction`).

No model was fitted to the held-out rows, but the held-out rows selected the epoch whose weights are
used. The errors on held-out rows are therefore slightly optimistic.
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
    """Fitted physics, and a prediction of every row by a model that was not fitted to the row.

    Attributes:
        model: Model fitted to all training data.
        predicted: (N, n) effort of every row, predicted by a model that was fitted to the other
            folds; rows without a fold are predicted by `model`.
        valid: (N,) whether the prediction of the row is valid in every joint.
        fold: (N,) number of the fold of each row; −1 for rows without a fold.
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
    """Predict every row by a model that was not fitted to the trajectory of the row.

    Args:
        dataset: Dataset with all rows; test rows are predicted, but never used for fitting.
        model: Model fitted to all training data.
        folds: Number of folds; with 1 fold, `model` predicts every row.
        seed: Seed for the assignment of trajectories to folds.
        fit: Function from a dataset and the number of the omitted fold to a newly fitted model.
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
    """Return the fold (N,) of every row; a trajectory with all its loads is in one fold.

    With fewer than two trajectories, no row has a fold. If a study divides trajectories row by row,
    no row has a fold either, because a fold would not separate neighbouring rows from the training
    rows.
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
    """Trained networks, and their outputs for rows on which they were not trained.

    Attributes:
        networks: List with one network per fold, or with a single network if there are no folds.
        correction: (N, n) network outputs for the validation rows, in effort units.
        judged: (N,) mask of the validation rows.
        used: (N,) mask of all rows used for training or validation of any network.
        curves: Learning curves of each network.
    """

    networks: tuple[TrainedTcn, ...]
    correction: FloatArray
    judged: BoolArray
    used: BoolArray
    curves: tuple[Curves, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Result of the evaluation of the networks on held-out rows.

    Attributes:
        selection: Joints that use their network, and the errors that decided so.
        correction: Correction of predictions, restricted to the joints that use their network and
            limited in size.
        bands: Error bands, calibrated on the errors relative to the measured effort, as recorded.
        coverage: Share of held-out samples within bands that were calibrated without the trajectory
            of the sample; empty if there is only one trajectory.
        sigma: (n,) root mean square error of each joint relative to the measured effort.
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
        """Evaluate the networks on their validation rows.

        Args:
            data: Prepared dataset.
            physics: Predictions of the rows by the physics. If there are folds, the predictions
                come from models that were not fitted to the predicted rows.
            learnt: Trained networks and their corrections.
            margin: Required relative decrease of the error, as in `select`.
            coverage: Share of samples that the bands should contain.
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
        # Bands are validated by omitting whole folds, or single trajectories if there are no folds.
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
    """Return the mean coverage of each part by bands that were calibrated on the other parts."""
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
    """Joints that use their network, and the errors on which the selection is based.

    Attributes:
        kept: (n,) whether the prediction of the joint is corrected by its network.
        without, corrected: (n,) RMSE on held-out rows without and with the network, in effort
            units.
        better: (n,) share of the held-out trajectories on which the network lowers the error.
        margin: Required relative decrease of the error.
    """

    kept: BoolArray
    without: FloatArray
    corrected: FloatArray
    better: FloatArray
    margin: float

    def facts(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """Return one entry per joint for `model.json`."""
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
        """Return the selection from the result of `facts`.

        Raises:
            KeyError, TypeError, ValueError: An entry of the facts is missing or not a number.
        """
        without, corrected, better = (
            np.array([float(one[key]) for one in facts]) for key in ("without", "with", "better_on")
        )
        kept = np.array([bool(one["kept"]) for one in facts])
        return Selection(kept, without, corrected, better, margin)

    def notes(
        self, joint_names: Sequence[str], unit: str, rows: str = "left-out trajectories"
    ) -> tuple[str, ...]:
        """Return notes that list the joints with and without a network, and the error per joint.

        Args:
            joint_names: n joint names.
            unit: Unit of the errors.
            rows: Description of the rows on which the errors were computed.
        """
        notes = []
        asked = f"; required: at least {100 * self.margin:g} % less error on nearly all of them"
        for word, chosen, why in (("kept", self.kept, ""), ("dropped", ~self.kept, asked)):
            if np.any(chosen):
                joints = ", ".join(self._joint(int(j), joint_names) for j in np.flatnonzero(chosen))
                notes.append(f"residual network {word} for {joints} {unit} on {rows}{why}")
        return tuple(notes)

    def _joint(self, j: int, names: Sequence[str]) -> str:
        return f"{names[j]} ({self.without[j]:.3g} → {self.corrected[j]:.3g})"


KEPT, LIMIT = "kept", "limit"

SURE = 0.9
"""Confidence of the one-sided interval on which the selection is based."""

TINY = 1e-300


def select(
    without: FloatArray, corrected: FloatArray, blocks: IntArray, margin: float
) -> Selection:
    """Select the joints whose network lowers the error on held-out rows.

    The network must lower the error over all rows by the share `margin`. In addition, the upper end
    of the one-sided 90 % confidence interval of the mean logarithm of the error ratio per
    trajectory (Student's t) must be below 0. An improvement can then be expected on other
    trajectories. A single trajectory gives no confidence interval, so no network is selected. With
    a margin of 0 the confidence interval is not checked.

    Args:
        without: (N, n) prediction errors of the physics alone, by models that were not fitted to
            these rows.
        corrected: (N, n) prediction errors with the network, by networks that were not trained on
            these rows.
        blocks: (N,) number of the trajectory of every row.
        margin: Required relative decrease of the error, at least 0.
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
    """Return the upper end (n,) of the confidence interval of the mean; infinite for B = 1."""
    count = len(gains)
    if count < 2:
        return np.full(gains.shape[1], np.inf)
    error = np.std(gains, axis=0, ddof=1) / np.sqrt(count)
    return np.asarray(np.mean(gains, axis=0) + student_quantile(SURE, count - 1) * error)


NETWORK = "network{}."
"""Prefix of the array names of a network, to which the network's number, from 1, is added."""

NUMBERED = re.compile(r"network(\d+)\.")


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Correction of predictions by the mean output of several networks.

    Attributes:
        settings: Settings of every network.
        networks: List of at least one network, even if no joint uses a network.
        kept: (n,) whether the prediction of the joint is corrected.
        limit: (n,) largest correction in effort units: the largest residual in the held-out rows.
            The limit is necessary because the output of a network is unpredictable for loads and
            motions that were not in the training data.
    """

    settings: ResidualSettings
    networks: tuple[TrainedTcn, ...]
    kept: BoolArray
    limit: FloatArray

    def predict(self, data: Dataset, base: FloatArray) -> FloatArray:
        """Return the correction (N, n) for prepared data; the correction is 0 at standstill.

        Raises:
            DataError: A required torque input is missing, or the data have a different sample rate.
        """
        moving = in_motion(data)
        if not np.any(moving) or not np.any(self.kept):
            return np.zeros_like(base)
        motions = Motions.of(data, base, self.settings)
        mean = np.mean([network.predict(motions) for network in self.networks], axis=0)
        return np.where(moving[:, None], self.bounded(mean), 0.0)

    def bounded(self, mean: FloatArray) -> FloatArray:
        """Return the networks' mean (…, n) clipped to the limits; 0 for joints without network."""
        return np.where(self.kept, np.clip(mean, -self.limit, self.limit), 0.0)

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays for a model file; the settings are stored separately."""
        arrays = {KEPT: self.kept.astype(np.float64), LIMIT: self.limit}
        for number, network in enumerate(self.networks, start=1):
            arrays |= with_prefix(NETWORK.format(number), network.to_arrays())
        return arrays

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: dict[str, Any], networks: int
    ) -> Correction:
        """Return the correction from the result of `to_arrays`.

        Raises:
            KeyError, ValueError, DataError: An array is missing or invalid.
        """
        stored = {int(named[1]) for name in arrays if (named := NUMBERED.match(name))}
        if not stored or networks != len(stored) or networks != max(stored) or min(stored) < 1:
            raise ValueError(f"networks: {networks}, but the stored ones are {sorted(stored)}")
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
    # f_cut_hz need not be finite, because a network without a split does not use it.
    require_finite_arrays({name: a for name, a in arrays.items() if name != "f_cut_hz"})
    return TrainedTcn.from_arrays(arrays, settings)
