"""Zero-phase filtering and differentiation, series by series.

The defaults are the preprocessing of Mamedov & Mikhel (Front. Robot. AI 7, 2020) for the UR10e,
found again on their recordings: measured velocity filtered by a Butterworth of order 5 run
forwards and backwards at 0.15 of the Nyquist frequency; acceleration by central differences of
the *filtered* velocity over the true time stamps, filtered once more at 0.15; current filtered at
0.20; positions left as they are.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hil.data.dataset import Conditions, Dataset
from hil.errors import DataError
from hil.typing import BoolArray, FloatArray

MAX_NYQUIST_FRACTION = 0.8
"""Above this the bilinear transform squeezes the stop band to nothing."""

PAUSE_STEPS = 3.0
"""A step in time longer than this many median steps is a pause: no filter may run across it."""

AT_REST = ("dwell", "reference")
"""Series kinds that stand still: too short to filter, and with nothing to differentiate."""

Cutoff = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class FilterSettings(BaseModel):
    """How a dataset is prepared for identification.

    Attributes:
        order: Order of the Butterworth filter; run twice, it acts with twice the order.
        unit: Whether cut-offs are fractions of the Nyquist frequency or Hz.
        position: Cut-off for `q`, None to leave it as measured.
        velocity: Cut-off for `qd`.
        acceleration: Cut-off for `qdd`, applied after differentiating the filtered velocity.
        effort: Cut-off for `effort`, the fitting target.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    order: Annotated[int, Field(ge=1, le=10)] = 5
    unit: Literal["nyquist", "hz"] = "nyquist"
    position: Cutoff | None = None
    velocity: Cutoff = 0.15
    acceleration: Cutoff = 0.15
    effort: Cutoff = 0.20


def sample_rate(t: FloatArray) -> float:
    """Mean sample rate [Hz] of time stamps (N,), pauses left out.

    What a pause is, `PAUSE_STEPS` says; series read from recordings hold none. The mean is used
    because stamps of millisecond resolution alternate (10 ms, 12 ms), so their median is off by
    several per cent.

    Raises:
        DataError: Fewer than two samples, or time does not increase.
    """
    steps = np.diff(t)
    if len(steps) == 0 or not np.all(steps > 0):
        raise DataError("the sample rate needs at least two strictly increasing time stamps")
    return float(1.0 / np.mean(steps[~is_pause(steps)]))


def is_pause(steps: FloatArray) -> BoolArray:
    """(M,) which of the steps in time (M,) between successive samples are pauses."""
    if not len(steps):
        return np.zeros(0, dtype=bool)
    longer: BoolArray = steps > PAUSE_STEPS * np.median(steps)
    return longer


def nyquist_fraction(cutoff: float, unit: str, rate_hz: float) -> float:
    """The cut-off as a fraction of the Nyquist frequency.

    Raises:
        DataError: It lies above 0.8 of the Nyquist frequency.
    """
    fraction = cutoff if unit == "nyquist" else cutoff / (0.5 * rate_hz)
    if not 0 < fraction <= MAX_NYQUIST_FRACTION:
        highest = 0.5 * MAX_NYQUIST_FRACTION * rate_hz
        raise DataError(
            f"a cut-off at {fraction:.3g} of the Nyquist frequency is too high "
            f"for samples at {rate_hz:.4g} Hz",
            hint=f"choose at most {MAX_NYQUIST_FRACTION} (nyquist) or {highest:.4g} (hz)",
        )
    return fraction


def zero_phase(values: FloatArray, fraction: float, order: int = 5) -> FloatArray:
    """Butterworth filter along axis 0, forwards and backwards, without phase shift.

    Args:
        values: (N,) or (N, n).
        fraction: Cut-off as a fraction of the Nyquist frequency.
        order: Order of one pass.

    Raises:
        DataError: There are too few samples for the filter's edges.
    """
    from scipy.signal import butter, sosfiltfilt

    needed = shortest_series(order)
    if len(values) < needed:
        raise DataError(
            f"{len(values)} samples are too few for a zero-phase filter of order {order}",
            hint=f"it needs {needed}; leave the series out or lower the order",
        )
    sections = butter(order, fraction, output="sos")
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=needed - 1)
    return filtered


def shortest_series(order: int) -> int:
    """Fewest samples that `zero_phase` of this order accepts."""
    return 3 * (order + 1) + 1


def derivative(values: FloatArray, t: FloatArray) -> FloatArray:
    """Time derivative along axis 0 by central differences that respect uneven time stamps.

    Second order inside, one-sided at both ends.

    Raises:
        DataError: Time does not increase strictly.
    """
    if len(t) < 2 or not np.all(np.diff(t) > 0):
        raise DataError(
            "cannot differentiate: time stamps repeat, run backwards or are fewer than two",
            hint="import the file again with --drop-bad-rows",
        )
    slope: FloatArray = np.gradient(values, t, axis=0)
    return slope


def prepare(dataset: Dataset, settings: FilterSettings | None = None) -> Dataset:
    """Add the columns `q_f`, `qd_f`, `qdd_f`, `effort_f`, each (N, n).

    A missing velocity is differentiated from position. Series at rest (dwells, references) keep
    their measured position and effort and get zero velocity and acceleration.

    Raises:
        DataError: A series is too short, holds NaN, or a cut-off is too high for its rate.
    """
    chosen = settings or FilterSettings()
    out = {name: np.zeros_like(dataset["q"]) for name in ("q_f", "qd_f", "qdd_f", "effort_f")}
    for condition, rows in dataset.slices():
        if rows.stop > rows.start:
            for name, values in _prepare_series(dataset, condition, rows, chosen).items():
                out[name][rows] = values
    return dataset.with_columns(**out)


def is_prepared(dataset: Dataset) -> bool:
    """True when `prepare` has added its columns."""
    return {"q_f", "qd_f", "qdd_f", "effort_f"} <= dataset.columns.keys()


def _prepare_series(
    dataset: Dataset, condition: Conditions, rows: slice, settings: FilterSettings
) -> dict[str, FloatArray]:
    q, effort = dataset["q"][rows], dataset["effort"][rows]
    if condition.kind in AT_REST:
        return {"q_f": q, "effort_f": effort}
    try:
        return _filter_series(dataset["t"][rows], q, _velocity(dataset, rows), effort, settings)
    except DataError as error:
        raise DataError(f"series {condition.id}: {error.message}", hint=error.hint) from error


def _velocity(dataset: Dataset, rows: slice) -> FloatArray:
    if "qd" in dataset.columns:
        return dataset["qd"][rows]
    return derivative(dataset["q"][rows], dataset["t"][rows])


def _filter_series(
    t: FloatArray, q: FloatArray, qd: FloatArray, effort: FloatArray, settings: FilterSettings
) -> dict[str, FloatArray]:
    for name, values in {"q": q, "qd": qd, "effort": effort}.items():
        require_finite(name, values)
    rate = sample_rate(t)

    def smooth(values: FloatArray, cutoff: float) -> FloatArray:
        fraction = nyquist_fraction(cutoff, settings.unit, rate)
        return zero_phase(values, fraction, settings.order)

    qd_f = smooth(qd, settings.velocity)
    return {
        "q_f": q if settings.position is None else smooth(q, settings.position),
        "qd_f": qd_f,
        "qdd_f": smooth(derivative(qd_f, t), settings.acceleration),
        "effort_f": smooth(effort, settings.effort),
    }


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
