"""Evaluation of a model on new data, by source, kind, trajectory, payload and motion.

`rmse_raw` is the RMS difference between predicted and measured effort. `rmse_filtered` is the RMS
difference between the predicted effort and the measured effort after a zero-phase Butterworth
filter of order 5 at 0.20 of the Nyquist frequency, applied to each series. Only the *measured*
signal is filtered, never the prediction. `noise_floor` is the RMS of the raw minus the filtered
effort, which is the part of the signal above `cutoff_hz`. The part above the cut-off is noise if
the motion is slower than the cut-off. Friction at a reversal is not noise; a model that predicts
this friction can have an `rmse_raw` below the noise floor.

Dwells are too short to filter. For a dwell, the mean effort replaces the filtered signal, and
`noise_floor` is the scatter about the mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, card, number
from hil.data import (
    AT_REST,
    Conditions,
    Dataset,
    Model,
    Prediction,
    correlation,
    mep,
    nrmse,
    rmse,
    sample_rate,
    shortest_series,
    zero_phase,
)

MEASURED_CUTOFF = 0.20
"""Cut-off of the filter for measured efforts, as a fraction of the Nyquist frequency."""

MEASURED_ORDER = 5

MOVING_RAD_S = 0.05
"""Speed above which a joint counts as moving [rad/s]; slower joints count as static."""

METRICS = ("rmse_raw", "rmse_filtered", "noise_floor", "nrmse", "mep", "r")


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Prediction errors of a model on one group of rows.

    Attributes:
        by: Kind of the group (`all`, `source`, `kind`, `trajectory`, `load`, `motion`).
        name: Name of the group as shown to the user.
        samples: Number of rows that were evaluated.
        rmse_raw, rmse_filtered: (n,) RMS errors relative to the raw and to the filtered effort, in
            the unit of the effort.
        noise_floor: (n,) RMS of the measured minus the filtered effort, which is the high-frequency
            part, or the scatter within dwells. The error `rmse_raw` can be smaller than the noise
            floor.
        nrmse: (n,) `rmse_raw` divided by the standard deviation of the training or measured signal.
        mep: (n,) largest prediction error in per cent of the largest measured magnitude.
        r: (n,) correlation of measured and predicted effort.
    """

    by: str
    name: str
    samples: int
    rmse_raw: FloatArray
    rmse_filtered: FloatArray
    noise_floor: FloatArray
    nrmse: FloatArray
    mep: FloatArray
    r: FloatArray

    def mean(self, metric: str) -> float:
        """Return the mean of a metric over joints with a finite value; NaN if there are none."""
        values = np.asarray(getattr(self, metric))
        known = values[np.isfinite(values)]
        return float(np.mean(known)) if len(known) else float("nan")

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as JSON values: lists per joint, and means; None if undefined."""
        out: dict[str, Any] = {"by": self.by, "name": self.name, "samples": self.samples}
        out |= {metric: _listed(getattr(self, metric)) for metric in METRICS}
        means = {"mean_raw": self.mean("rmse_raw"), "mean_filtered": self.mean("rmse_filtered")}
        return out | {key: value if np.isfinite(value) else None for key, value in means.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Prediction errors of a model on a dataset.

    Attributes:
        unit: Unit of the effort, `A` or `N·m`.
        joint_names: Joint names in the order of every (n,) array.
        total: Prediction errors on all evaluated rows.
        tables: Prediction errors on all groups, without the group `all`.
        coverage: Share of the rows with a valid prediction; only these rows are evaluated.
        series: Ids of the series that were evaluated.
        cutoff_hz: Lowest and highest cut-off of the filter over the filtered series [Hz]; None if
            no series is filtered. Instead of being filtered, dwells are averaged.
    """

    unit: str
    joint_names: tuple[str, ...]
    total: Errors
    tables: tuple[Errors, ...] = field(default_factory=tuple)
    coverage: float = 1.0
    series: tuple[str, ...] = ()
    cutoff_hz: tuple[float, float] | None = None

    def __repr__(self) -> str:
        mean = f"{self.total.mean('rmse_raw'):.4g} {self.unit}"
        return f"<Evaluation on {self.total.samples} samples: mean RMSE {mean}>"

    def _repr_html_(self) -> str:
        """Return the errors as an HTML table for a notebook."""
        total = self.total
        facts = {
            "samples": f"{total.samples:,}",
            "judged": f"{100 * self.coverage:.3g} % of the rows",
            "mean RMSE": f"{number(total.mean('rmse_raw'))} {self.unit}",
        }
        head = ("", *self.joint_names, "mean")
        rows = [
            (name, *map(number, getattr(total, metric)), number(total.mean(metric)))
            for name, metric in (
                (f"RMSE raw [{self.unit}]", "rmse_raw"),
                (f"RMSE filtered [{self.unit}]", "rmse_filtered"),
                ("NRMSE", "nrmse"),
            )
        ]
        return card("Evaluation", "", facts, table=(head, rows))

    def table(self, by: str) -> tuple[Errors, ...]:
        """Return the prediction errors on the groups of one kind."""
        return tuple(errors for errors in self.tables if errors.by == by)

    def to_dict(self) -> dict[str, Any]:
        """Return the evaluation in a form that JSON can store."""
        return {
            "unit": self.unit,
            "joint_names": list(self.joint_names),
            "coverage": self.coverage,
            "total": self.total.to_dict(),
            "tables": [errors.to_dict() for errors in self.tables],
            "series": list(self.series),
            "cutoff_hz": None if self.cutoff_hz is None else list(self.cutoff_hz),
        }


def evaluate(
    model: Model,
    dataset: Dataset,
    train_std: FloatArray | None = None,
    *,
    prediction: Prediction | None = None,
) -> Evaluation:
    """Return the prediction errors of a model on a dataset.

    Args:
        model: Fitted model; its filter settings are used for the motion from which it predicts.
        dataset: Data that were not used in the fit (see `hil.data.assert_disjoint`).
        train_std: (n,) standard deviation of the training signal for `nrmse`; None for the standard
            deviation of the evaluated group.
        prediction: Prediction of the model for the dataset, if already computed; None to compute
            it.

    Raises:
        DataError: Robot or unit of the data differ from those of the model, or a series is too
            short to filter.
    """
    if prediction is None:
        prediction = model.predict(dataset)
    judged = prediction.valid & np.isfinite(dataset["effort"])
    signals = _Signals(
        dataset["effort"], filtered_effort(dataset), prediction.effort, judged, train_std
    )
    groups = [signals.errors(by, name, rows[:, None]) for by, name, rows in _groups(dataset)]
    groups += [signals.errors("motion", name, rows) for name, rows in _motion(dataset)]
    total = signals.errors("all", "all", np.ones((len(dataset), 1), dtype=bool))
    coverage = float(np.mean(np.all(judged, axis=1))) if len(dataset) else 0.0
    series = tuple(condition.id for condition in dataset.conditions)
    unit, names = dataset.effort_unit, dataset.joint_names
    cutoff = cutoff_hz(dataset)
    return Evaluation(unit, names, total, tuple(groups), coverage, series, cutoff)


def filtered_effort(dataset: Dataset) -> FloatArray:
    """Return (N, n) the measured effort, filtered per series; dwells are averaged.

    Motions that are too short for the filter are not filtered.
    """
    out = np.array(dataset["effort"])
    for condition, rows in dataset.slices():
        if rows.stop > rows.start and condition.kind in AT_REST:
            out[rows] = np.mean(out[rows], axis=0)
        elif _is_filtered(condition, rows):
            out[rows] = zero_phase(out[rows], MEASURED_CUTOFF, MEASURED_ORDER)
    return out


def cutoff_hz(dataset: Dataset) -> tuple[float, float] | None:
    """Return the lowest and highest cut-off over the filtered series [Hz]; None without such.

    The cut-off is a fraction of the Nyquist frequency; its value in Hz therefore depends on the
    sample rate.
    """
    found = [
        MEASURED_CUTOFF * sample_rate(dataset["t"][rows]) / 2
        for condition, rows in dataset.slices()
        if _is_filtered(condition, rows)
    ]
    return (min(found), max(found)) if found else None


def _is_filtered(condition: Conditions, rows: slice) -> bool:
    long_enough = rows.stop - rows.start >= shortest_series(MEASURED_ORDER)
    return condition.kind not in AT_REST and long_enough


@dataclass(frozen=True, slots=True, eq=False)
class _Signals:
    measured: FloatArray
    filtered: FloatArray
    predicted: FloatArray
    judged: BoolArray
    train_std: FloatArray | None

    def errors(self, by: str, name: str, rows: BoolArray) -> Errors:
        """Return the prediction errors over the evaluated rows of a group.

        The mask `rows` has the shape (N, 1), or (N, n) if the rows differ between joints.
        """
        chosen = self.judged & rows
        joints = [self._of_joint(j, chosen[:, j]) for j in range(chosen.shape[1])]
        found = {metric: np.array([joint[metric] for joint in joints]) for metric in METRICS}
        return Errors(by, name, int(np.any(chosen, axis=1).sum()), **found)

    def _of_joint(self, j: int, rows: BoolArray) -> dict[str, float]:
        measured, filtered, predicted = (
            values[rows, j, None] for values in (self.measured, self.filtered, self.predicted)
        )
        scale = None if self.train_std is None else self.train_std[j, None]
        values = (
            rmse(measured, predicted),
            rmse(filtered, predicted),
            rmse(measured, filtered),
            nrmse(measured, predicted, scale),
            mep(measured, predicted),
            correlation(measured, predicted),
        )
        return {metric: float(value[0]) for metric, value in zip(METRICS, values, strict=True)}


def _groups(dataset: Dataset) -> Iterator[tuple[str, str, BoolArray]]:
    """Yield the kind, the name and the row mask of every group of series."""
    series = dataset.series_index()
    for by, name_of in _GROUPINGS.items():
        names = np.array([name_of(condition) for condition in dataset.conditions], dtype=object)
        for name in dict.fromkeys(names):
            if name:
                yield by, str(name), (names == name)[series]


def _motion(dataset: Dataset) -> Iterator[tuple[str, BoolArray]]:
    """Yield the masks (N, n) of the moving and of the static samples of each joint."""
    if "qd" in dataset.columns:
        moving = np.abs(dataset["qd"]) > MOVING_RAD_S
        yield "moving", moving
        yield "standstill", ~moving


def _trajectory(condition: Conditions) -> str:
    if condition.trajectory < 0:
        return ""
    return f"{condition.source}#{condition.trajectory}"


_GROUPINGS: dict[str, Callable[[Conditions], str]] = {
    "source": lambda condition: condition.source,
    "kind": lambda condition: condition.kind,
    "trajectory": _trajectory,
    "load": lambda condition: f"{condition.load}: {condition.payload.mass:g} kg",
}


def _listed(values: FloatArray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]
