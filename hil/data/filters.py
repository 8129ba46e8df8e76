"""Zero-phase filtering, differentiation and down-sampling, series by series.

`prepare` adds filtered columns to a dataset, `filter_columns` filters the columns of a regressor
like the effort, and `downsample` then leaves out the samples that a fit does not need. They share
settings, low-pass filter and derivatives, defined below.

The defaults are the preprocessing of Mamedov & Mikhel (Front. Robot. AI 7, 2020) for the UR10e,
confirmed on their recordings: measured velocity filtered by a Butterworth filter of order 5 run
forwards and backwards at 0.15 of the Nyquist frequency; acceleration by central differences of
the *filtered* velocity over the true time stamps, filtered once more at 0.15; current filtered at
0.20; positions left as they are. The preset `paper` is that of the PINN paper.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from hil.core import BoolArray, DataError, FloatArray, IntArray
from hil.data.dataset import AT_REST, PREPARED, Conditions, Dataset, rows_of

# Settings


Cutoff = Annotated[float, Field(gt=0, allow_inf_nan=False)]

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "order": 5,
        "unit": "hz",
        "position": 50.0,
        "velocity": 50.0,
        "acceleration": 50.0,
        "effort": 50.0,
    }
}
"""Section IV of the PINN paper: recorded at 1 kHz, a fifth-order Butterworth filter at 50 Hz
forwards and backwards over all signals. Which samples it keeps afterwards, it does not say."""


class FilterSettings(BaseModel):
    """How a dataset is prepared for identification.

    Validated from a mapping, or from the name of a preset; keys beside `preset` replace its values.

    Attributes:
        preset: Source of the settings that are not specified, None for the defaults.
        order: Order of the Butterworth filter; run twice, it acts with twice the order.
        unit: Whether cut-offs are fractions of the Nyquist frequency or Hz.
        position: Cut-off for `q`, None to leave it as measured.
        velocity: Cut-off for `qd`.
        acceleration: Cut-off for `qdd`, applied after differentiating the filtered velocity.
        effort: Cut-off for `effort`, the fitting target.
        velocity_from: Source of `qd`: as measured (where it was), or the derivative of `q`.
        derivative: How signals are differentiated.
        window: Samples in each fit of `savitzky-golay`, odd.
        degree: Degree of its polynomials.
        every: A fit uses one filtered sample in so many.
        rate_hz: The same as a rate: the nearest that whole steps allow. None for `every`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Literal["paper"] | None = None
    order: Annotated[int, Field(ge=1, le=10)] = 5
    unit: Literal["nyquist", "hz"] = "nyquist"
    position: Cutoff | None = None
    velocity: Cutoff = 0.15
    acceleration: Cutoff = 0.15
    effort: Cutoff = 0.20
    velocity_from: Literal["measured", "position"] = "measured"
    derivative: Literal["central", "savitzky-golay"] = "central"
    window: Annotated[int, Field(ge=3, le=201)] = 9
    degree: Annotated[int, Field(ge=1, le=6)] = 3
    every: Annotated[int, Field(ge=1)] = 1
    rate_hz: Cutoff | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, value: Any) -> Any:
        keys = {"preset": value} if isinstance(value, str) else value
        if not isinstance(keys, dict):
            return keys
        return {**PRESETS.get(str(keys.get("preset")), {}), **keys}

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.window % 2 == 0 or self.window <= self.degree:
            raise ValueError(
                f"window: {self.window} samples must be odd and more than the degree {self.degree}"
            )
        if self.every > 1 and self.rate_hz is not None:
            raise ValueError("every, rate_hz: two ways of saying the same; give one of them")
        return self

    @property
    def downsamples(self) -> bool:
        """Whether a fit leaves samples out."""
        return self.every > 1 or self.rate_hz is not None


# Preparation of a dataset


def prepare(dataset: Dataset, settings: FilterSettings | None = None) -> Dataset:
    """Return the dataset with the columns `q_f`, `qd_f`, `qdd_f`, `effort_f`, each (N, n).

    A missing velocity is differentiated from position. Series at rest (dwells, references) keep
    their measured position and effort and get zero velocity and acceleration. All rows stay:
    `downsample` leaves some out, once everything that needs neighbours is computed.

    Raises:
        DataError: A series is too short, holds NaN, or a cut-off is too high for its rate.
    """
    chosen = settings or FilterSettings()
    out = {name: np.zeros_like(dataset["q"]) for name in PREPARED}
    for condition, rows in dataset.slices():
        if rows.stop == rows.start:
            continue
        if condition.kind in AT_REST:
            prepared = {"q_f": dataset["q"][rows], "effort_f": dataset["effort"][rows]}
        else:
            try:
                prepared = _filter_motion(dataset, rows, chosen)
            except DataError as error:
                raise _in_series(condition, error) from error
        for name, values in prepared.items():
            out[name][rows] = values
    return dataset.with_columns(**out)


def _filter_motion(
    dataset: Dataset, rows: slice, settings: FilterSettings
) -> dict[str, FloatArray]:
    """Return the columns that `prepare` adds, for the rows of one motion."""
    t, q, effort = (dataset[name][rows] for name in ("t", "q", "effort"))
    require_finite("q", q)
    measured = settings.velocity_from == "measured" and "qd" in dataset.columns
    qd = dataset["qd"][rows] if measured else _slope(q, t, settings)
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
    """Return values filtered with the cut-off of the signal `name`."""
    try:
        fraction = nyquist_fraction(getattr(settings, name), settings.unit, sample_rate(t))
    except DataError as error:
        raise DataError(f"filters, {name}: {error.message}", hint=error.hint) from error
    return zero_phase(values, fraction, settings.order)


def _slope(values: FloatArray, t: FloatArray, settings: FilterSettings) -> FloatArray:
    if settings.derivative == "central":
        return derivative(values, t)
    return polynomial_derivative(values, t, settings.window, settings.degree)


def _in_series(condition: Conditions, error: DataError) -> DataError:
    """Return the error with the series in which it occurred."""
    return DataError(f"series {condition.id}: {error.message}", hint=error.hint)


def is_prepared(dataset: Dataset) -> bool:
    """Return whether `prepare` has added its columns."""
    return set(PREPARED) <= dataset.columns.keys()


def filter_columns(values: FloatArray, dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """Return columns (N, …) filtered as the effort they explain, series by series.

    A filter smears the reversals of an effort; unfiltered columns would explain it with biased
    friction. The same linear filter on both sides of τ = W β leaves β unchanged (parallel
    filtering; Gautier 1997). Series at rest stay as they are, as their effort does.

    Args:
        values: (N, …), a row per row of the dataset. Call before `downsample`: afterwards, columns
            with steps are aliased.
        dataset: Where series begin and how fast they were sampled.
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
            stride = _stride_of(dataset, rows)
            recorded_hz = stride * sample_rate(dataset["t"][rows])
            fraction = stride * nyquist_fraction(settings.effort, settings.unit, recorded_hz)
            out[rows] = zero_phase(values[rows], fraction, settings.order)
        except DataError as error:
            raise _in_series(condition, error) from error
    return out


def require_finite(name: str, values: Any) -> None:
    """Raise if a value is NaN or infinite, with the row and joint of the first one.

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


# Low-pass filter and the sample rates it refers to


MAX_NYQUIST_FRACTION = 0.8
"""Above this the bilinear transform squeezes the stop band to nothing."""

MIN_NYQUIST_FRACTION = 1e-6
"""Below this nothing passes, and soon the filter cannot be computed."""

CLOCK = 5e-3
"""Share by which a robot's clock may run slow: 50 Hz is 0.8 of the Nyquist frequency at 125 Hz, and
has to be allowed at 124.98 Hz."""

PAUSE_STEPS = 3.0
"""A step in time longer than this many median steps is a pause: no filter may run across it."""


def zero_phase(values: FloatArray, fraction: float, order: int = 5) -> FloatArray:
    """Return values filtered along axis 0 by a Butterworth low-pass, with zero phase.

    It runs forwards and backwards.

    Args:
        values: (N,) or (N, …).
        fraction: Cut-off as a fraction of the Nyquist frequency.
        order: Order of one pass.

    Raises:
        DataError: There are too few samples for the filter's edges.
    """
    from scipy.signal import sosfiltfilt

    needed = shortest_series(order)
    if len(values) < needed:
        raise DataError(
            f"{len(values)} samples are too few for a zero-phase filter of order {order}",
            hint=f"it needs {needed}; leave the series out or lower the order",
        )
    sections = _low_pass(order, fraction).copy()  # SciPy does not warrant that it only reads them
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=needed - 1)
    return filtered


@lru_cache(maxsize=64)
def _low_pass(order: int, fraction: float) -> FloatArray:
    """Return the sections of a Butterworth filter; to design one takes as long as to run it."""
    from scipy.signal import butter

    sections: FloatArray = butter(order, fraction, output="sos")
    return sections


def shortest_series(order: int) -> int:
    """Return the fewest samples that `zero_phase` of this order accepts."""
    return 3 * (order + 1) + 1


def nyquist_fraction(cutoff: float, unit: str, rate_hz: float) -> float:
    """Return a cut-off as a fraction of the Nyquist frequency.

    Args:
        cutoff: In `unit`.
        unit: `nyquist` or `hz`, as in `FilterSettings`.
        rate_hz: Sample rate [Hz].

    Raises:
        DataError: It lies above 0.8 of the Nyquist frequency, or below a millionth.
    """
    fraction = cutoff if unit == "nyquist" else cutoff / (0.5 * rate_hz)
    if 0 < fraction < MIN_NYQUIST_FRACTION:
        raise DataError(
            f"a cut-off at {cutoff:.4g} {unit} lets nothing through of samples at {rate_hz:.4g} Hz",
            hint="look at the unit of the time stamps: they have to be seconds; or raise the "
            "cut-off",
        )
    if not 0 < fraction <= MAX_NYQUIST_FRACTION * (1 + CLOCK):
        highest = 0.5 * MAX_NYQUIST_FRACTION * rate_hz
        raise DataError(
            f"a cut-off at {fraction:.3g} of the Nyquist frequency is too high "
            f"for samples at {rate_hz:.4g} Hz",
            hint=f"choose at most {MAX_NYQUIST_FRACTION} (nyquist) or {highest:.4g} (hz)",
        )
    return fraction


def sample_rate(t: FloatArray) -> float:
    """Return the mean sample rate [Hz] of time stamps (N,), pauses left out.

    `is_pause` says what a pause is; series read from recordings hold none. The mean is used
    because stamps of millisecond resolution alternate (10 ms, 12 ms), so their median is off by
    several per cent.

    Raises:
        DataError: Fewer than two samples, or time does not increase.
    """
    steps = np.diff(t)
    if len(steps) == 0 or not np.all(steps > 0):
        raise DataError(
            "the sample rate needs at least two strictly increasing time stamps",
            hint="import the file again with --drop-bad-rows, or leave the series out",
        )
    return float(1.0 / np.mean(steps[~is_pause(steps)]))


def is_pause(steps: FloatArray) -> BoolArray:
    """Return (M,) which of the steps in time (M,) between successive samples are pauses."""
    if not len(steps):
        return np.zeros(0, dtype=bool)
    longer: BoolArray = steps > PAUSE_STEPS * np.median(steps)
    return longer


# Derivatives, over the time stamps as they are


_BLOCK = 8192
"""Samples whose polynomials are fitted at once; bounds memory on long series."""


def derivative(values: FloatArray, t: FloatArray) -> FloatArray:
    """Return the time derivative along axis 0 by central differences over uneven time stamps.

    Second order inside, one-sided at both ends.

    Raises:
        DataError: Time does not increase strictly.
    """
    _require_increasing(t)
    slope: FloatArray = np.gradient(values, t, axis=0)
    return slope


def polynomial_derivative(
    values: FloatArray, t: FloatArray, window: int, degree: int
) -> FloatArray:
    """Return the time derivative along axis 0 of a polynomial fitted about every sample.

    On even stamps that is the filter of Savitzky & Golay (Anal. Chem. 36, 1964). Here each fit
    is over the true times: stamps that alternate (10 ms, 12 ms) taken for even ones would put
    their alternation, times the speed, into the derivative. Towards the ends of the series the
    window stays inside and the polynomial is differentiated off its middle.

    Args:
        values: (N,) or (N, n).
        t: (N,).
        window: Samples per fit, odd, more than `degree`.
        degree: Of the polynomials.

    Raises:
        DataError: Time does not increase strictly, or there are fewer samples than the window.
    """
    _require_increasing(t)
    if len(t) < window:
        raise DataError(
            f"{len(t)} samples are too few for polynomials over {window}",
            hint="leave the series out, or choose a shorter window",
        )
    flat = values.reshape(len(t), -1)
    slope = np.empty(flat.shape)
    for start in range(0, len(t), _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, len(t)))
        first = np.clip(rows - window // 2, 0, len(t) - window)
        weights = _slope_weights(t, rows, first, window, degree)
        slope[rows] = sum(weights[:, k, None] * flat[first + k] for k in range(window))
    return slope.reshape(values.shape)


def _slope_weights(
    t: FloatArray, rows: IntArray, first: IntArray, window: int, degree: int
) -> FloatArray:
    """Return (R, window) weights of the samples in the slope at each row."""
    time = t[first[:, None] + np.arange(window)] - t[rows, None]
    # Times of the order of 1 keep the normal equations well conditioned.
    scale = 0.5 * (time[:, -1] - time[:, 0])
    powers = (time / scale[:, None])[..., None] ** np.arange(degree + 1)
    gram = np.swapaxes(powers, 1, 2) @ powers
    slope = np.zeros((len(rows), degree + 1, 1))
    slope[:, 1] = 1.0
    solved = powers @ np.linalg.solve(gram, slope)
    return np.asarray(solved[..., 0] / scale[:, None])


def _require_increasing(t: FloatArray) -> None:
    if len(t) < 2 or not np.all(np.diff(t) > 0):
        raise DataError(
            "cannot differentiate: time stamps repeat, run backwards or are fewer than two",
            hint="import the file again with --drop-bad-rows",
        )


# Down-sampling: after the low-pass filter, neighbours say nearly the same


_STRIDE = "stride"
"""Column (N,) of a down-sampled dataset: how many recorded samples each row stands for."""


def downsample(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """Return the rows a fit uses: one in so many of each motion, counted from its first.

    For fits only: predictions are of every row. Columns computed from neighbouring samples
    (filtered ones, states of friction) are added before.

    Args:
        dataset: Prepared with the same settings.
        settings: Their `every` or `rate_hz`; without either all rows stay.

    Raises:
        DataError: The remaining samples are too few for what the filters let through.
    """
    if not settings.downsamples:
        return dataset
    strides = _strides(dataset, settings)
    return rows_of(dataset.with_columns(**{_STRIDE: strides}), _mask(dataset, strides))


def downsampling_mask(dataset: Dataset, settings: FilterSettings) -> BoolArray:
    """Return (N,) which rows `downsample` keeps; all of dwells and references.

    Raises:
        DataError: The remaining samples are too few for what the filters let through.
    """
    return _mask(dataset, _strides(dataset, settings))


def _mask(dataset: Dataset, strides: FloatArray) -> BoolArray:
    within = np.arange(len(dataset)) - dataset.offsets[:-1][dataset.series_index()]
    return np.asarray(within % strides == 0)


def _strides(dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """Return (N,) of how many samples of its series one stays."""
    strides = np.ones(len(dataset))
    for condition, rows in _motions(dataset):
        strides[rows] = _stride(condition, sample_rate(dataset["t"][rows]), settings)
    return strides


def _stride(condition: Conditions, rate: float, settings: FilterSettings) -> int:
    """Return of how many samples one stays, in a series sampled at `rate` [Hz]."""
    every = settings.every
    if settings.rate_hz is not None:
        every = max(1, round(rate / settings.rate_hz))
    present = (settings.velocity, settings.acceleration, settings.effort, settings.position)
    highest = max(cutoff for cutoff in present if cutoff is not None)
    passed = highest * 0.5 * rate if settings.unit == "nyquist" else highest
    # The same bound as that of the filter: what is beyond would come back as a lower frequency.
    most = max(1, int(MAX_NYQUIST_FRACTION * 0.5 * rate / passed * (1 + CLOCK)))
    if every > most:
        raise DataError(
            f"series {condition.id}: one sample in {every} at {rate:.4g} Hz is too few for "
            f"signals filtered at {passed:.4g} Hz",
            hint=f"keep one in {most} (every: {most}, or rate_hz: {rate / most:.4g}), "
            "or lower the cut-offs",
        )
    return every


def _stride_of(dataset: Dataset, rows: slice) -> float:
    """Return how many recorded samples each row of a series stands for: 1 before `downsample`."""
    return float(dataset.columns[_STRIDE][rows.start]) if _STRIDE in dataset.columns else 1.0


def motion_rates(dataset: Dataset) -> list[tuple[float, str]]:
    """Return samples per second and id of every series of at least two samples that moves.

    Raises:
        DataError: Time does not increase.
    """
    rates = []
    for condition, rows in _motions(dataset):
        try:
            rates.append((sample_rate(dataset["t"][rows]), condition.id))
        except DataError as error:
            raise _in_series(condition, error) from error
    return rates


def _motions(dataset: Dataset) -> list[tuple[Conditions, slice]]:
    """Return the series that move and have at least two samples."""
    return [
        (condition, rows)
        for condition, rows in dataset.slices()
        if condition.kind not in AT_REST and rows.stop - rows.start > 1
    ]
