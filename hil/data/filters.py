"""Zero-phase filtering and differentiation, series by series.

The defaults are the preprocessing of Mamedov & Mikhel (Front. Robot. AI 7, 2020) for the UR10e,
found again on their recordings: measured velocity filtered by a Butterworth of order 5 run
forwards and backwards at 0.15 of the Nyquist frequency; acceleration by central differences of
the *filtered* velocity over the true time stamps, filtered once more at 0.15; current filtered at
0.20; positions left as they are. `paper` names those of the PINN paper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.core import DataError, FloatArray
from hil.data.dataset import PREPARED, Conditions, Dataset
from hil.data.filtering.butterworth import (
    CLOCK,
    MAX_NYQUIST_FRACTION,
    PAUSE_STEPS,
    is_pause,
    nyquist_fraction,
    sample_rate,
    shortest_series,
    zero_phase,
)
from hil.data.filtering.derivative import derivative, local_slope
from hil.data.filtering.downsampling import (
    AT_REST,
    downsample,
    kept_rows,
    motion_rates,
    stride_of,
)
from hil.data.filtering.settings import PRESETS, FilterSettings

__all__ = [
    "AT_REST",
    "CLOCK",
    "MAX_NYQUIST_FRACTION",
    "PAUSE_STEPS",
    "PRESETS",
    "FilterSettings",
    "derivative",
    "downsample",
    "filter_columns",
    "is_pause",
    "is_prepared",
    "kept_rows",
    "local_slope",
    "motion_rates",
    "nyquist_fraction",
    "prepare",
    "require_finite",
    "sample_rate",
    "shortest_series",
    "zero_phase",
]


def prepare(dataset: Dataset, settings: FilterSettings | None = None) -> Dataset:
    """Add the columns `q_f`, `qd_f`, `qdd_f`, `effort_f`, each (N, n).

    A missing velocity is differentiated from position. Series at rest (dwells, references) keep
    their measured position and effort and get zero velocity and acceleration. All rows stay:
    leaving some out is up to `downsample`, once everything that needs neighbours is computed.

    Raises:
        DataError: A series is too short, holds NaN, or a cut-off is too high for its rate.
    """
    chosen = settings or FilterSettings()
    out = {name: np.zeros_like(dataset["q"]) for name in PREPARED}
    for condition, rows in dataset.slices():
        if rows.stop > rows.start:
            for name, values in _prepare_series(dataset, condition, rows, chosen).items():
                out[name][rows] = values
    return dataset.with_columns(**out)


def is_prepared(dataset: Dataset) -> bool:
    """True when `prepare` has added its columns."""
    return set(PREPARED) <= dataset.columns.keys()


def filter_columns(values: FloatArray, dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """Columns (N, …) through the filter of the effort they explain, series by series.

    A filtered effort has its reversals smeared; columns that are not, explain it with biased
    friction. The same linear filter over both sides of τ = W β leaves β where it was (parallel
    filtering; Gautier 1997). Series at rest stay as they are, as their effort does.

    Args:
        values: (N, …), a row per row of the dataset. Best before any is left out by `downsample`;
            afterwards the filter is at the same frequency, but columns with steps have folded.
        dataset: Says where series begin and how fast they were sampled.
        settings: Those the effort was filtered with.

    Raises:
        DataError: A series is too short, holds NaN, or the cut-off is too high for its rate.
    """
    out = np.array(values, dtype=np.float64)
    for condition, rows in dataset.slices():
        if condition.kind in AT_REST or rows.stop == rows.start:
            continue
        try:
            require_finite("the columns", values[rows])
            stride = stride_of(dataset, rows)
            recorded_hz = stride * sample_rate(dataset["t"][rows])
            fraction = stride * nyquist_fraction(settings.effort, settings.unit, recorded_hz)
            out[rows] = zero_phase(values[rows], fraction, settings.order)
        except DataError as error:
            raise DataError(f"series {condition.id}: {error.message}", hint=error.hint) from error
    return out


def _prepare_series(
    dataset: Dataset, condition: Conditions, rows: slice, settings: FilterSettings
) -> dict[str, FloatArray]:
    q, effort = dataset["q"][rows], dataset["effort"][rows]
    if condition.kind in AT_REST:
        return {"q_f": q, "effort_f": effort}
    measured = settings.velocity_from == "measured" and "qd" in dataset.columns
    try:
        qd = dataset["qd"][rows] if measured else None
        return _filter_series(dataset["t"][rows], q, qd, effort, settings)
    except DataError as error:
        raise DataError(f"series {condition.id}: {error.message}", hint=error.hint) from error


def _filter_series(
    t: FloatArray,
    q: FloatArray,
    measured: FloatArray | None,
    effort: FloatArray,
    settings: FilterSettings,
) -> dict[str, FloatArray]:
    require_finite("q", q)
    qd = _slope(q, t, settings) if measured is None else measured
    require_finite("qd", qd)
    require_finite("effort", effort)
    qd_f = _smooth("velocity", qd, t, settings)
    return {
        "q_f": q if settings.position is None else _smooth("position", q, t, settings),
        "qd_f": qd_f,
        "qdd_f": _smooth("acceleration", _slope(qd_f, t, settings), t, settings),
        "effort_f": _smooth("effort", effort, t, settings),
    }


def _smooth(name: str, values: FloatArray, t: FloatArray, settings: FilterSettings) -> FloatArray:
    """Through the low-pass filter of the signal of that name."""
    try:
        fraction = nyquist_fraction(getattr(settings, name), settings.unit, sample_rate(t))
    except DataError as error:
        raise DataError(f"filters, {name}: {error.message}", hint=error.hint) from error
    return zero_phase(values, fraction, settings.order)


def _slope(values: FloatArray, t: FloatArray, settings: FilterSettings) -> FloatArray:
    if settings.derivative == "central":
        return derivative(values, t)
    return local_slope(values, t, settings.window, settings.degree)


def require_finite(name: str, values: Any) -> None:
    """Refuse NaN and infinity, saying in which row and joint the first one sits.

    Raises:
        DataError: A value is not finite.
    """
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        where = " joint ".join(str(i + 1) for i in bad[0])
        raise DataError(
            f"{len(bad)} values of {name} are not finite, the first in row {where}",
            hint="import the file again with --drop-bad-rows, or leave the series out",
        )
