"""Judging a model on data it has not seen: per source, kind, trajectory, load, and motion.

`rmse_raw` compares with the effort as it was measured, `rmse_filtered` with the same signal after
a zero-phase Butterworth filter of order 5 at 0.20 of the Nyquist frequency, series by series. Only
the *measured* signal is filtered, never the prediction. What the filter takes away, raw minus
filtered, is kept as `noise_floor`: the part of the signal above `cutoff_hz`. It is noise as far as
the motion is slower than that; friction at a reversal is not, and a model that follows it gets
`rmse_raw` below this part.
Dwells are too short to filter; there, a dwell's mean stands for the filtered signal, and
`noise_floor` is the scatter about it.
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
"""Of the Nyquist frequency."""

MEASURED_ORDER = 5

MOVING_RAD_S = 0.05
"""A joint faster than this is moving; slower, it is at or near standstill."""

METRICS = ("rmse_raw", "rmse_filtered", "noise_floor", "nrmse", "mep", "r")


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """How good a model is on one group of rows.

    Attributes:
        by: What the group is a group of (`all`, `source`, `kind`, `trajectory`, `load`, `motion`).
        name: Which one, for people.
        samples: Rows that were judged.
        rmse_raw, rmse_filtered: (n,) in the unit of the effort.
        noise_floor: (n,) RMS of measured minus filtered: the high-frequency part, or the scatter
            within dwells. No lower bound for `rmse_raw`.
        nrmse: (n,) `rmse_raw` over the standard deviation of the training or measured signal.
        mep: (n,) largest error in per cent of the largest measured magnitude.
        r: (n,) correlation of measured and predicted.
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
        """Mean of a metric over the joints it is defined for; NaN if there are none."""
        values = np.asarray(getattr(self, metric))
        known = values[np.isfinite(values)]
        return float(np.mean(known)) if len(known) else float("nan")

    def to_dict(self) -> dict[str, Any]:
        """JSON form: lists per joint and the means of both RMSEs; undefined values are null."""
        out: dict[str, Any] = {"by": self.by, "name": self.name, "samples": self.samples}
        out |= {metric: _listed(getattr(self, metric)) for metric in METRICS}
        means = {"mean_raw": self.mean("rmse_raw"), "mean_filtered": self.mean("rmse_filtered")}
        return out | {key: value if np.isfinite(value) else None for key, value in means.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A model's errors on a dataset.

    Attributes:
        unit: `A` or `N·m`.
        joint_names: Order of every (n,) array.
        total: All judged rows.
        tables: Every grouping, `all` not among them.
        coverage: Share of the rows for which the model says its prediction is valid; only those
            are judged.
        series: Ids of the series judged.
        cutoff_hz: Lowest and highest cut-off of the filter over the motions; None when there are
            none (dwells are averaged instead).
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
        """Itself in a notebook."""
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
        """The groups of one grouping."""
        return tuple(errors for errors in self.tables if errors.by == by)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
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
    """Judge a model on a dataset.

    Args:
        model: A fitted model; its own filters act on the motion it predicts from.
        dataset: Data the model has not seen (see `hil.data.assert_disjoint`).
        train_std: (n,) standard deviation of the training signal for `nrmse`; by default that of
            the group judged.
        prediction: What the model predicts for the dataset, if it is known; else it is computed.

    Raises:
        DataError: The data are of another robot or unit, or a series is too short to filter.
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
    """(N, n) the measured effort, filtered per series; dwells are averaged instead.

    Motions too short for the filter's edges stay as they are.
    """
    out = np.array(dataset["effort"])
    for condition, rows in dataset.slices():
        if rows.stop > rows.start and condition.kind in AT_REST:
            out[rows] = np.mean(out[rows], axis=0)
        elif _is_filtered(condition, rows):
            out[rows] = zero_phase(out[rows], MEASURED_CUTOFF, MEASURED_ORDER)
    return out


def cutoff_hz(dataset: Dataset) -> tuple[float, float] | None:
    """Lowest and highest cut-off over the series that are filtered; None without any.

    A fraction of the Nyquist frequency is another frequency for every sample rate.
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
        """Errors over the judged rows; `rows` is (N, 1), or (N, n) to choose per joint."""
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
    """Every grouping of the series, with its rows."""
    series = dataset.series_index()
    for by, name_of in _GROUPINGS.items():
        names = np.array([name_of(condition) for condition in dataset.conditions], dtype=object)
        for name in dict.fromkeys(names):
            if name:
                yield by, str(name), (names == name)[series]


def _motion(dataset: Dataset) -> Iterator[tuple[str, BoolArray]]:
    """Rows (N, n) in which each joint by itself moves or stands still."""
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
