"""Zero-phase filtering, differentiation and down-sampling of each series.

`prepare` adds filtered columns to a dataset. `filter_columns` filters the columns of a regressor in
the same way as the effort. `downsample` leaves out samples that a fit does not need. The functions
`prepare`, `filter_columns` and `downsample` use the same settings, low-pass filter and derivatives,
which this module defines.

The default settings are the preprocessing of Mamedov & Mikhel (Front. Robot. AI 7, 2020) for the
UR10e, confirmed on their recordings. A Butterworth filter of order 5, run forwards and backwards,
filters the measured velocity at 0.15 of the Nyquist frequency. The acceleration is the central
difference of the *filtered* velocity over the true time stamps, and is filtered again at 0.15. The
current is filtered at 0.20 of the Nyquist frequency, and positions are not filtered. The preset
`paper` is the preprocessing of the PINN paper.
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
"""Filter settings by the name of the preset.

The preset `paper` follows section IV of the PINN paper: recording at 1 kHz, and a fifth-order
Butterworth filter at 50 Hz, run forwards and backwards over all signals. The PINN paper does not
state which samples are used after the filter.
"""


class FilterSettings(BaseModel):
    """Settings for the preparation of a dataset for identification.

    The settings are read from a mapping or from the name of a preset, and are validated; keys next
    to `preset` replace the values of the preset.

    Attributes:
        preset: Name of the preset that defines unspecified settings; None for the default settings.
        order: Order of the Butterworth filter for one pass; the two passes double the order.
        unit: Unit of the cut-off frequencies: fractions of the Nyquist frequency, or Hz.
        position: Cut-off frequency for `q`; None for no filter.
        velocity: Cut-off frequency for `qd`.
        acceleration: Cut-off frequency for `qdd`, applied after differentiation of the filtered
            velocity.
        effort: Cut-off frequency for `effort`, the target of the fit.
        velocity_from: Source of `qd`: the measured velocity if available, or the derivative of `q`.
        derivative: Name of the differentiation method.
        window: Number of samples in each polynomial fit of `savitzky-golay`, odd.
        degree: Degree of the polynomials of `savitzky-golay`.
        every: Down-sampling factor k of a fit, which uses one of k filtered samples.
        rate_hz: Sample rate of a fit [Hz], an alternative to `every`, rounded to an integer
            down-sampling factor; None to use `every`.
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
            raise ValueError("every, rate_hz: both set the down-sampling; give only one of them")
        return self

    @property
    def downsamples(self) -> bool:
        """Whether a fit uses only some of the samples."""
        return self.every > 1 or self.rate_hz is not None


# Preparation of a dataset


def prepare(dataset: Dataset, settings: FilterSettings | None = None) -> Dataset:
    """Return the dataset with the columns `q_f`, `qd_f`, `qdd_f`, `effort_f`, each (N, n).

    A missing velocity is computed from the measured position. Series at rest (dwells, references)
    keep their measured position and effort; they are assigned zero velocity and acceleration. All
    rows of the dataset are kept; `downsample` removes rows later, after all computations that need
    neighbouring rows.

    Raises:
        DataError: A series is too short or contains NaN, or a cut-off is too high for its sample
            rate.
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
    """Return the filtered columns for the rows of one motion in a dataset."""
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
    """Return the values of a signal after the filter with the cut-off of the signal `name`."""
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
    """Return the error with the id of the series added to its message."""
    return DataError(f"series {condition.id}: {error.message}", hint=error.hint)


def is_prepared(dataset: Dataset) -> bool:
    """Return whether a dataset has the filtered columns that `prepare` adds."""
    return set(PREPARED) <= dataset.columns.keys()


def filter_columns(values: FloatArray, dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """Return regressor columns (N, …) after the effort filter, applied to each series.

    A filter smooths the steps of an effort at velocity reversals. Together with a filtered effort,
    unfiltered regressor columns would give biased friction parameters. If the same linear filter is
    applied to both sides of τ = W β, β does not change (parallel filtering; Gautier 1997). The
    columns of series at rest are not filtered, because the effort of these series is not filtered
    either.

    Args:
        values: (N, …) columns with one row per row of the dataset. `filter_columns` must be called
            before `downsample`, because down-sampled columns with steps are aliased.
        dataset: Dataset that defines the series and their sample rates.
        settings: Filter settings, of which the effort cut-off is used.

    Raises:
        DataError: A series is too short or contains NaN, or the effort cut-off is too high for its
            sample rate.
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
    """Raise if a value is NaN or infinite; the message contains its row and joint.

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


# Low-pass filter and sample rates


MAX_NYQUIST_FRACTION = 0.8
"""Maximum cut-off as a fraction of the Nyquist frequency.

Above this fraction, the bilinear transform of the filter leaves no useful stop band.
"""

MIN_NYQUIST_FRACTION = 1e-6
"""Minimum cut-off as a fraction of the Nyquist frequency.

Below this fraction, the filter blocks all signals and becomes numerically unstable.
"""

CLOCK = 5e-3
"""Tolerance for the clock rate of a robot, as a share of the rate.

A cut-off of 50 Hz is 0.8 of the Nyquist frequency at 125 Hz, and must also be accepted at 124.98
Hz.
"""

PAUSE_STEPS = 3.0
"""Ratio of a time step to the median time step above which the time step is a pause.

No filter may run across a pause in a recording.
"""


def zero_phase(values: FloatArray, fraction: float, order: int = 5) -> FloatArray:
    """Return values filtered along axis 0 by a Butterworth low-pass with zero phase.

    The low-pass filter runs forwards and backwards.

    Args:
        values: (N,) or (N, …) signals.
        fraction: Cut-off of the filter as a fraction of the Nyquist frequency.
        order: Order of the filter in one pass.

    Raises:
        DataError: There are too few samples for the transients of the filter.
    """
    from scipy.signal import sosfiltfilt

    needed = shortest_series(order)
    if len(values) < needed:
        raise DataError(
            f"{len(values)} samples are too few for a zero-phase filter of order {order}",
            hint=f"it needs {needed}; leave the series out or lower the order",
        )
    sections = _low_pass(order, fraction).copy()  # SciPy possibly writes into the array
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=needed - 1)
    return filtered


@lru_cache(maxsize=64)
def _low_pass(order: int, fraction: float) -> FloatArray:
    """Return the second-order sections of a Butterworth low-pass filter.

    The filter sections are cached, because the design takes as long as the filtering.
    """
    from scipy.signal import butter

    sections: FloatArray = butter(order, fraction, output="sos")
    return sections


def shortest_series(order: int) -> int:
    """Return the minimum number of samples that `zero_phase` accepts for a filter order."""
    return 3 * (order + 1) + 1


def nyquist_fraction(cutoff: float, unit: str, rate_hz: float) -> float:
    """Return a cut-off as a fraction of the Nyquist frequency.

    Args:
        cutoff: Cut-off frequency in `unit`.
        unit: Unit of the cut-off, `nyquist` or `hz`, as in `FilterSettings`.
        rate_hz: Sample rate of the signal [Hz].

    Raises:
        DataError: The cut-off is above 0.8 or below one millionth of the Nyquist frequency.
    """
    fraction = cutoff if unit == "nyquist" else cutoff / (0.5 * rate_hz)
    if 0 < fraction < MIN_NYQUIST_FRACTION:
        raise DataError(
            f"a cut-off at {cutoff:.4g} {unit} removes the whole signal at a sample rate of "
            f"{rate_hz:.4g} Hz",
            hint="check the unit of the time stamps, which must be seconds, or raise the cut-off",
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
    """Return the mean sample rate [Hz] of time stamps (N,), without pauses.

    `is_pause` defines which time steps are pauses; series from recordings contain no pauses. The
    median of the time steps is not used, because time stamps with a resolution of 1 ms alternate
    (10 ms, 12 ms), so that their median is wrong by several per cent.

    Raises:
        DataError: There are fewer than two samples, or the time stamps do not increase.
    """
    steps = np.diff(t)
    if len(steps) == 0 or not np.all(steps > 0):
        raise DataError(
            "the sample rate needs at least two strictly increasing time stamps",
            hint="import the file again with --drop-bad-rows, or leave the series out",
        )
    return float(1.0 / np.mean(steps[~is_pause(steps)]))


def is_pause(steps: FloatArray) -> BoolArray:
    """Return (M,) whether each of the time steps (M,) between successive samples is a pause."""
    if not len(steps):
        return np.zeros(0, dtype=bool)
    longer: BoolArray = steps > PAUSE_STEPS * np.median(steps)
    return longer


# Derivatives over the true time stamps


_BLOCK = 8192
"""Number of samples whose polynomials are fitted at the same time; bounds the memory use."""


def derivative(values: FloatArray, t: FloatArray) -> FloatArray:
    """Return the time derivative along axis 0 by central differences over uneven time stamps.

    The differences are of second order inside the series and one-sided at the two ends.

    Raises:
        DataError: The time stamps do not increase strictly.
    """
    _require_increasing(t)
    slope: FloatArray = np.gradient(values, t, axis=0)
    return slope


def polynomial_derivative(
    values: FloatArray, t: FloatArray, window: int, degree: int
) -> FloatArray:
    """Return the time derivative along axis 0 of a polynomial fitted around every sample.

    For evenly spaced time stamps, the differentiation is the filter of Savitzky & Golay (Anal.
    Chem. 36, 1964). In this function, each fit uses the true times. If alternating time stamps (10
    ms, 12 ms) were treated as even, the derivative would contain an error of their alternation
    times the velocity. Near the ends of the series, the window of samples stays inside the series,
    so that the polynomial is differentiated away from its centre.

    Args:
        values: (N,) or (N, n) signals.
        t: (N,) time [s].
        window: Number of samples per fit; odd and larger than `degree`.
        degree: Degree of the fitted polynomials.

    Raises:
        DataError: The time stamps do not increase strictly, or there are fewer samples than
            `window`.
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
    """Return (R, window) the weights of the samples in the derivative for each row."""
    time = t[first[:, None] + np.arange(window)] - t[rows, None]
    # Times are scaled to the order of 1, so that the normal equations are well conditioned.
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


# Down-sampling: after the low-pass filter, neighbouring samples are nearly equal


_STRIDE = "stride"
"""Name of the column (N,) with the down-sampling factor of each remaining row."""


def downsample(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """Return the rows that a fit uses: every k-th row of each motion, beginning with its first row.

    Only fits use down-sampled data; predictions are computed for every row. Columns that depend on
    neighbouring samples (filtered columns, friction states) must be added before down-sampling.

    Args:
        dataset: Dataset that was prepared with the same filter settings.
        settings: Filter settings with `every` or `rate_hz`; without these values, all rows are
            returned.

    Raises:
        DataError: The sample rate after down-sampling is too low for the cut-offs of the filters.
    """
    if not settings.downsamples:
        return dataset
    strides = _strides(dataset, settings)
    return rows_of(dataset.with_columns(**{_STRIDE: strides}), _mask(dataset, strides))


def downsampling_mask(dataset: Dataset, settings: FilterSettings) -> BoolArray:
    """Return (N,) a mask of the rows that `downsample` returns.

    All rows of dwells and references are returned.

    Raises:
        DataError: The sample rate after down-sampling is too low for the cut-offs of the filters.
    """
    return _mask(dataset, _strides(dataset, settings))


def _mask(dataset: Dataset, strides: FloatArray) -> BoolArray:
    within = np.arange(len(dataset)) - dataset.offsets[:-1][dataset.series_index()]
    return np.asarray(within % strides == 0)


def _strides(dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """Return (N,) the down-sampling factor of the series to which each row belongs."""
    strides = np.ones(len(dataset))
    for condition, rows in _motions(dataset):
        strides[rows] = _stride(condition, sample_rate(dataset["t"][rows]), settings)
    return strides


def _stride(condition: Conditions, rate: float, settings: FilterSettings) -> int:
    """Return the down-sampling factor of a series with sample rate `rate` [Hz]."""
    every = settings.every
    if settings.rate_hz is not None:
        every = max(1, round(rate / settings.rate_hz))
    present = (settings.velocity, settings.acceleration, settings.effort, settings.position)
    highest = max(cutoff for cutoff in present if cutoff is not None)
    passed = highest * 0.5 * rate if settings.unit == "nyquist" else highest
    # The bound equals that of the filter, because higher frequencies would be aliased.
    most = max(1, int(MAX_NYQUIST_FRACTION * 0.5 * rate / passed * (1 + CLOCK)))
    if every > most:
        raise DataError(
            f"series {condition.id}: one sample in {every} at {rate:.4g} Hz is too few for "
            f"signals with a cut-off of {passed:.4g} Hz",
            hint=f"keep one in {most} (every: {most}, or rate_hz: {rate / most:.4g}), "
            "or lower the cut-offs",
        )
    return every


def _stride_of(dataset: Dataset, rows: slice) -> float:
    """Return the down-sampling factor of the rows of a series; 1 if not down-sampled."""
    return float(dataset.columns[_STRIDE][rows.start]) if _STRIDE in dataset.columns else 1.0


def motion_rates(dataset: Dataset) -> list[tuple[float, str]]:
    """Return the sample rate [Hz] and id of every series in motion with at least two samples.

    Raises:
        DataError: The time stamps of a series do not increase.
    """
    rates = []
    for condition, rows in _motions(dataset):
        try:
            rates.append((sample_rate(dataset["t"][rows]), condition.id))
        except DataError as error:
            raise _in_series(condition, error) from error
    return rates


def _motions(dataset: Dataset) -> list[tuple[Conditions, slice]]:
    """Return the conditions and rows of the series in motion that have at least two samples."""
    return [
        (condition, rows)
        for condition, rows in dataset.slices()
        if condition.kind not in AT_REST and rows.stop - rows.start > 1
    ]
