"""Training data of a residual network: settings, motions, inputs, crops, slow and fast parts.

`ResidualSettings` selects the inputs of the network, its memory and its size. `Motions` contains
the series of a dataset, `NetworkInputs` scales them into network inputs, and `Segments` cuts them
into crops for training. The module `residual_data` does not need torch.

`slow_and_fast` splits a residual into two parts (PINN paper, eq. 24). The slow part of a residual
has the frequencies of the motion; the fast part is caused by reversals of joints. The slow part and
the fast part are training targets. The filter that separates the parts may use later samples,
because the filter is not used for predictions. The filter must not use test rows. In each series
the filter therefore runs from the first to the last training row. All other rows in this range are
replaced by linear interpolation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from math import gcd
from typing import Any, Literal, get_args

import numpy as np

from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray, SpecError
from hil.data import AT_REST, Dataset, group_of, motion_rates
from hil.estimators import choice, flag, number, require_known, whole

Heard = Literal["motion", "history", "measured"]
Layout = Literal["grouped", "joint"]
Activation = Literal["tanh", "relu"]

CHANNELS: dict[Layout, int] = {"grouped": 12, "joint": 48}
"""Default number of channels of a layer in each group, by layout."""

APART_HZ = 249.0
"""Lower limit of the rate of training instants [Hz]: five times the signal band of 50 Hz."""

MOST_SAMPLES = 100_000
"""Maximum memory of a network and maximum length of a crop [samples]; 100 s at 1 kHz."""

GROUP = "residual"
"""Name of the only parameter group, used in stages and learning rates."""

TRAINING: dict[str, Any] = {
    "epochs": 60,
    "batch_size": 16,
    "learning_rate": 3e-3,
    "loss": "mse",
    "patience": 20,
}
"""Default `TrainingSettings` of a residual network; each training sample is a crop."""


@dataclass(frozen=True, slots=True)
class ResidualSettings:
    """Settings of the residual network, after eq. 24–27 of the PINN paper.

    Attributes:
        inputs: Torque inputs of the network: `motion`, `history` or `measured`. With `motion`, the
            network has no torque inputs. With `history`, the network uses the measured torque up to
            `latency_s` before the predicted instant. With `measured`, the network uses the torque
            of the predicted instant, as in the PINN paper, although this torque is the quantity to
            be predicted.
        latency_s: Age of the newest torque that a network with `history` uses [s].
        layout: Assignment of networks to joints: `grouped` or `joint`. With `grouped`, there is one
            network per joint, which uses only the inputs of that joint. With `joint`, there is one
            network for all joints, which uses q, q̇ and q̈ of all joints, as in the PINN paper.
        dilations: Distance between the taps of each layer [samples].
        kernel: Number of taps of each layer.
        channels: Number of channels of every layer in each group; None means 12 for `grouped` and
            48 for `joint`.
        activation: Activation function of every layer.
        split: Whether the slow and the fast part of the residual have separate networks (eq. 24). A
            `split` of None means true for layout `joint` and false for `grouped`. Networks of
            single joints have a lower error without the split, because the slow part of few
            trajectories is soon overfitted.
        f_cut_hz: Cut-off frequency of the split [Hz]; with `auto`, the cut-off frequency is derived
            from the spectrum of the motion.
        sign_widths: Widths [rad/s] of the smooth signs tanh(q̇/width) among the inputs of grouped
            networks.
        base_input: Whether the prediction of the physical model is an input of grouped networks.
        crop: Number of instants that the network predicts for one training sample.
        every: Distance between the predicted instants of a crop [samples]; the input windows
            contain every sample. A distance above 1 loses little, because neighbouring samples of a
            filtered signal contain the same information. The distance must divide all dilations but
            the first, and reduces the cost of all layers after the first. With `every` None, the
            distance is the largest that `APART_HZ` permits.
    """

    inputs: Heard = "motion"
    latency_s: float = 0.02
    layout: Layout = "grouped"
    dilations: tuple[int, ...] = (1, 4, 16)
    kernel: int = 5
    channels: int | None = None
    activation: Activation = "tanh"
    split: bool | None = None
    f_cut_hz: float | Literal["auto"] = "auto"
    sign_widths: tuple[float, ...] = (0.005, 0.02, 0.1)
    base_input: bool = True
    crop: int = 64
    every: int | None = None

    def __post_init__(self) -> None:
        choice("inputs", self.inputs, get_args(Heard))
        choice("layout", self.layout, get_args(Layout))
        choice("activation", self.activation, get_args(Activation))
        number("latency_s", self.latency_s, above=0.0, at_most=60.0)
        self._whole("kernel", at_least=2, at_most=MOST_SAMPLES)
        self._whole("crop", at_least=1, at_most=MOST_SAMPLES)
        if self.channels is not None:
            self._whole("channels", at_least=1, at_most=4096)
        dilations = _several("dilations", self.dilations)
        self._set("dilations", tuple(whole("dilations", d, at_least=1) for d in dilations))
        if self.window > MOST_SAMPLES:
            raise SpecError(
                f"kernel {self.kernel} and dilations {', '.join(map(str, self.dilations))} reach "
                f"back {self.window} samples, but at most {MOST_SAMPLES} are allowed",
                hint="use fewer or smaller dilations",
            )
        if self.every is not None:
            self._whole("every", at_least=1)
            if self._common % self.every:
                raise SpecError(
                    f"every is {self.every}, but must divide the dilations "
                    f"{', '.join(map(str, self.dilations[1:]))}"
                )
        if self.split is not None:
            flag("split", self.split)
        flag("base_input", self.base_input)
        if self.f_cut_hz != "auto":
            number("f_cut_hz", self.f_cut_hz, above=0.0)
        for width in _several("sign_widths", self.sign_widths):
            number("sign_widths", width, above=0.0)

    def _whole(self, name: str, *, at_least: int, at_most: float | None = None) -> None:
        self._set(name, whole(name, getattr(self, name), at_least=at_least, at_most=at_most))

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # counts are stored as int, not as 5.0

    @property
    def window(self) -> int:
        """Number of samples on which an output depends, including the newest one: l of eq. 25."""
        return 1 + (self.kernel - 1) * sum(self.dilations)

    @property
    def width(self) -> int:
        """Number of channels of a layer in each group."""
        return CHANNELS[self.layout] if self.channels is None else self.channels

    @property
    def branches(self) -> int:
        """Number of networks whose outputs are added: 2 for slow and fast part, 1 for the sum."""
        return 2 if self.parted else 1

    @property
    def parted(self) -> bool:
        """Whether the slow part and the fast part of the residual have separate networks."""
        return self.layout == "joint" if self.split is None else self.split

    @property
    def protocol(self) -> str:
        """Evaluation protocol: `honest`, with the minimum age of torque inputs, or a deviation.

        If the latency is not a whole number of samples, the torque inputs are older than the
        reported age.
        """
        if self.inputs == "measured":
            return "paper: measured torque among the inputs"
        if self.inputs == "history":
            return f"honest: torque history ending at least {1e3 * self.latency_s:g} ms before"
        return "honest"

    def lag(self, rate_hz: float) -> int:
        """Return the number of samples from the newest torque input to the predicted instant."""
        # The factor makes 20 ms at 1 kHz give 20 samples in spite of rounding of the rate.
        samples = -int(-self.latency_s * rate_hz * (1.0 - 1e-6) // 1)
        return max(1, samples) if self.inputs == "history" else 0

    def apart(self, rate_hz: float) -> int:
        """Return the number of samples between two predicted instants of a crop."""
        if self.every is not None:
            return self.every
        fits = [k for k in range(1, self._common + 1) if self._common % k == 0]
        return max(k for k in fits if k == 1 or rate_hz / k >= APART_HZ)

    @property
    def _common(self) -> int:
        """Greatest common divisor of all dilations but the first; 1 with a single dilation."""
        return max(1, gcd(*self.dilations[1:]))

    def to_json(self) -> dict[str, Any]:
        """Return all settings in the form that `given` accepts."""
        return asdict(self)

    @staticmethod
    def given(settings: dict[str, Any]) -> ResidualSettings:
        """Return residual settings from keyword arguments, which contain lists in place of tuples.

        Raises:
            SpecError: A setting is unknown or has an invalid value.
        """
        require_known(settings, tuple(f.name for f in fields(ResidualSettings)), "network")
        listed: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in settings.items()
        }
        return ResidualSettings(**listed)


def _several(name: str, values: Any) -> tuple[Any, ...]:
    if not isinstance(values, tuple) or not values:
        raise SpecError(f"{name} is {values!r}, but must be a list of at least one number")
    return values


RATE_TOLERANCE = 0.05
"""Largest relative difference of sample rates at which a network's memory is considered equal."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Series of evenly spaced samples of n joints.

    Attributes:
        q, qd, qdd: (N, n) position, velocity and acceleration [rad, rad/s, rad/s²].
        base: (N, n) effort predicted by the physical model.
        effort: (N, n) measured effort for the network inputs, in the unit of `base`; None if the
            network does not use the measured effort.
        offsets: (S + 1,) number of the row at which each series begins; the last entry is N.
        rate_hz: Sample rate of the series in motion [Hz].
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    base: FloatArray
    effort: FloatArray | None
    offsets: IntArray
    rate_hz: float

    @staticmethod
    def of(dataset: Dataset, base: FloatArray, settings: ResidualSettings) -> Motions:
        """Return the motions of a dataset, with all rows and filtered columns.

        For `inputs: history` the recorded torque is used, because a zero-phase filter would mix
        later values into earlier ones. For `inputs: measured` the filtered torque is used, as in
        the PINN paper.

        Args:
            dataset: Prepared dataset (`hil.data.prepare`).
            base: (N, n) prediction of the physical model for the rows, in the effort unit of that
                model.
            settings: Settings that select the torque input.

        Raises:
            DataError: No series is in motion, or series have different sample rates.
        """
        effort = {"motion": None, "history": "effort", "measured": "effort_f"}[settings.inputs]
        return Motions(
            q=dataset["q_f"],
            qd=dataset["qd_f"],
            qdd=dataset["qdd_f"],
            base=base,
            effort=None if effort is None else dataset[effort],
            offsets=dataset.offsets,
            rate_hz=one_rate(dataset),
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    def slices(self) -> Iterator[slice]:
        """Yield the rows of each series that is not empty."""
        for start, stop in pairwise(self.offsets.tolist()):
            if stop > start:
                yield slice(start, stop)

    def heard(self, settings: ResidualSettings) -> FloatArray | None:
        """Return the torque input (N, n) of each row, or None for `inputs: motion`.

        The torque input of a row is NaN if no torque has arrived yet. With layout `grouped` and
        inputs `history`, the torque input is the past residual of the physical model; otherwise the
        torque input is the torque itself.

        Raises:
            DataError: The network needs a measured torque, but the motions have no measured torque.
        """
        if settings.inputs == "motion":
            return None
        if self.effort is None:
            raise DataError(
                f"inputs: {settings.inputs} needs the measured torque, but the data have none",
                hint="use recordings with an effort, or set inputs: motion",
            )
        if settings.inputs == "measured":
            return self.effort
        source = self.effort - self.base if settings.layout == "grouped" else self.effort
        lag = settings.lag(self.rate_hz)
        out = np.full_like(source, np.nan)
        for rows in self.slices():
            if rows.stop - rows.start > lag:
                out[rows][lag:] = source[rows][:-lag]
        return out


def one_rate(dataset: Dataset) -> float:
    """Return the sample rate [Hz] of the series in motion; static series may have any rate.

    Raises:
        DataError: No motion has at least two samples, or the rates of two series differ by over 5
            %.
    """
    rates = motion_rates(dataset)
    if not rates:
        raise DataError(
            "a residual network needs a motion of at least two samples, but the data have none",
            hint="give trajectories",
        )
    (low, slow), (high, quick) = min(rates), max(rates)
    if high > (1.0 + RATE_TOLERANCE) * low:
        raise DataError(
            f"{slow} is sampled at {low:.4g} Hz and {quick} at {high:.4g} Hz, but a residual "
            "network needs one sample rate",
            hint="use recordings with the same sample rate",
        )
    return float(np.median([rate for rate, _ in rates]))


def require_one_rate(data: Dataset) -> None:
    """Raise if series have different sample rates, because a network's memory counts samples.

    Raises:
        FitError: The rates of two series differ by more than 5 %, or no series is in motion.
    """
    try:
        one_rate(data)
    except DataError as error:
        raise FitError(error.message, hint=error.hint) from error


def in_motion(data: Dataset) -> BoolArray:
    """Return a mask (N,) of the rows of series in motion; networks apply only to these rows."""
    moving = np.zeros(len(data), dtype=bool)
    for condition, rows in data.slices():
        moving[rows] = condition.kind not in AT_REST
    return moving


def trajectory_numbers(data: Dataset) -> IntArray:
    """Return the trajectory number (N,) of every row, which does not depend on the mounted load."""
    known = [group_of(condition, "trajectory") for condition in data.conditions]
    keys = [("series", i) if group is None else group for i, group in enumerate(known)]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)[data.series_index()]


TINY = 1e-9
"""Constant added to scales; without the constant, the scale of a joint that never moves is zero."""


@dataclass(frozen=True, slots=True, eq=False)
class InputScales:
    """Means and standard deviations (n,) of the training rows, and the range of the inputs.

    Network inputs are clipped to the range of the training rows, because the output of a network
    outside that range is unpredictable.

    Attributes:
        q_mean, q, qd, qdd, base_mean, base, heard_mean, heard: Means (`…_mean`) and divisors of the
            inputs.
        lowest, highest: (G, F) minimum and maximum of the scaled inputs in the training rows.
    """

    q_mean: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    base_mean: FloatArray
    base: FloatArray
    heard_mean: FloatArray
    heard: FloatArray
    lowest: FloatArray
    highest: FloatArray

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: ResidualSettings, n: int
    ) -> InputScales:
        """Return the scales of n joints from the result of `to_arrays`.

        Raises:
            DataError: An array is missing or has a wrong shape.
        """
        shapes: dict[str, tuple[int, ...]] = {f.name: (n,) for f in fields(InputScales)}
        shapes |= dict.fromkeys(("lowest", "highest"), group_shape(settings, n))
        for name, shape in shapes.items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != shape:
                raise DataError(
                    f"the residual network's scale {name} has the shape {found}, not {shape}"
                )
        return InputScales(**{name: np.asarray(arrays[name]) for name in shapes})


def group_shape(settings: ResidualSettings, n: int) -> tuple[int, int]:
    """Return (G, F): the number of input groups and the number of inputs per group."""
    heard = int(settings.inputs != "motion")
    if settings.layout == "joint":
        return 1, n * (3 + heard)
    return n, 2 + len(settings.sign_widths) + int(settings.base_input) + heard


class NetworkInputs:
    """Scaled network inputs: G groups of F numbers, with one group per joint or one for all joints.

    Args:
        settings: Settings that select the inputs.
        scales: Scales from the method `scaled_to` or from a stored network.
    """

    def __init__(self, settings: ResidualSettings, scales: InputScales) -> None:
        self.settings = settings
        self.scales = scales

    @staticmethod
    def scaled_to(motions: Motions, rows: BoolArray, settings: ResidualSettings) -> NetworkInputs:
        """Return network inputs whose scales are computed from the training rows (N,)."""
        n = motions.n
        heard = motions.heard(settings)
        heard = np.zeros((len(motions), n)) if heard is None else heard
        known = heard[rows & np.all(np.isfinite(heard), axis=1)]
        known = known if len(known) else np.zeros((1, n))
        scales = InputScales(
            q_mean=motions.q[rows].mean(axis=0),
            q=motions.q[rows].std(axis=0) + TINY,
            # Velocities and accelerations are not centred, because zero means standstill.
            qd=_rms(motions.qd[rows]),
            qdd=_rms(motions.qdd[rows]),
            base_mean=motions.base[rows].mean(axis=0),
            base=motions.base[rows].std(axis=0) + TINY,
            heard_mean=known.mean(axis=0),
            heard=known.std(axis=0) + TINY,
            lowest=np.full((1, 1), -np.inf),
            highest=np.full((1, 1), np.inf),
        )
        inputs = NetworkInputs(settings, scales).of(motions)[rows]
        ranged = {f.name: getattr(scales, f.name) for f in fields(scales)}
        ranged |= {"lowest": inputs.min(axis=0), "highest": inputs.max(axis=0)}
        return NetworkInputs(settings, InputScales(**ranged))

    def of(self, motions: Motions) -> FloatArray:
        """Return the inputs (N, G, F) of every row."""
        heard = motions.heard(self.settings)
        return self.rows(motions.q, motions.qd, motions.qdd, motions.base, heard)

    def rows(
        self,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        base: FloatArray,
        heard: FloatArray | None,
    ) -> FloatArray:
        """Return the inputs (N, G, F) for arrays (N, n); `heard` comes from `Motions.heard`."""
        by_joint = self._grouped(qd, qdd, base) if self._own else self._joint(q, qd, qdd)
        if heard is not None:
            scaled = (heard - self.scales.heard_mean) / self.scales.heard
            # Values that have not arrived yet are replaced by the mean.
            by_joint.append(np.where(np.isfinite(scaled), scaled, 0.0))
        # (N, n, F) if grouped, else (N, 1, n·F).
        stacked = np.stack(by_joint, axis=-1)
        stacked = stacked if self._own else stacked.reshape(len(q), 1, -1)
        clipped: FloatArray = np.clip(stacked, self.scales.lowest, self.scales.highest)
        return clipped

    @property
    def _own(self) -> bool:
        return self.settings.layout == "grouped"

    def _grouped(self, qd: FloatArray, qdd: FloatArray, base: FloatArray) -> list[FloatArray]:
        s = self.scales
        signs = [np.tanh(qd / width) for width in self.settings.sign_widths]
        told = [(base - s.base_mean) / s.base] if self.settings.base_input else []
        return [qd / s.qd, *signs, qdd / s.qdd, *told]

    def _joint(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> list[FloatArray]:
        s = self.scales
        return [(q - s.q_mean) / s.q, qd / s.qd, qdd / s.qdd]


def _rms(values: FloatArray) -> FloatArray:
    root: FloatArray = np.sqrt(np.mean(values**2, axis=0)) + TINY
    return root


BEHIND = -1
"""Row number that marks positions after the end of a series."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Positions of crops in arrays whose series are padded at the start by `window - 1` rows.

    The padding at the start of a series repeats the first row of the series.

    Attributes:
        padded: (P,) row of the recording for each padded row.
        starts: (C,) padded row at which the first window of each crop begins.
        rows: (C, crop) row of the recording for each output of a crop.
        counted: (C, crop) whether each output contributes to the loss or the validation error.
        every: Number of rows between outputs.
    """

    padded: IntArray
    starts: IntArray
    rows: IntArray
    counted: BoolArray
    every: int

    @staticmethod
    def of(motions: Motions, counted: BoolArray, settings: ResidualSettings) -> Segments:
        """Return crops that cover every series and contain at least one counted row.

        The predicted instants of neighbouring crops are shifted by one row relative to each other;
        the crops thus contain all phases. Positions of a crop after the end of a series repeat the
        last row of the series and do not count.

        Args:
            motions: Motions to be divided into crops.
            counted: (N,) mask of the rows to predict.
            settings: Settings of the network.
        """
        every, crop = settings.apart(motions.rate_hz), settings.crop
        before, span = settings.window - 1, settings.crop * every
        padded, starts, rows = [], [], []
        offset = 0
        for part in motions.slices():
            length = part.stop - part.start
            firsts = np.arange(0, length, span)
            firsts += np.arange(len(firsts)) % every
            last = len(firsts) * span + every
            padded.append(part.start + np.arange(-before, last).clip(0, length - 1))
            starts.append(offset + firsts)
            at = firsts[:, None] + every * np.arange(crop)
            rows.append(np.where(at < length, part.start + at, BEHIND))
            offset += before + last
        at = np.concatenate(rows) if rows else np.empty((0, crop), dtype=np.int64)
        kept = np.append(counted, False)[at]
        chosen = np.any(kept, axis=1)
        return Segments(
            np.concatenate([np.empty(0, dtype=np.int64), *padded]),
            np.concatenate([np.empty(0, dtype=np.int64), *starts])[chosen],
            at.clip(0)[chosen],
            kept[chosen],
            every,
        )

    def __len__(self) -> int:
        return len(self.starts)

    def inputs_of(self, numbers: IntArray, settings: ResidualSettings) -> IntArray:
        """Return the numbers of the padded rows that are the inputs of the crops (B,).

        The returned array has the shape (B, (crop - 1)·every + window).
        """
        length = (settings.crop - 1) * self.every + settings.window
        return np.asarray(self.starts[numbers, None] + np.arange(length))


def sizes(parts: FloatArray, rows: BoolArray) -> FloatArray:
    """Return the root mean square (branches, n) of each part over the training rows; 1 if zero."""
    root: FloatArray = np.sqrt(np.mean(parts[:, rows] ** 2, axis=1))
    # A part that is zero is not scaled.
    return np.where(root > 0.0, root, 1.0)


POWER_SHARE = 0.99
"""Share of the joints' velocity power below the highest frequency of the motion."""

ORDER = 2
"""Order of the Butterworth filter, which is applied forwards and backwards."""

MOST_OF_NYQUIST = 0.8
"""Share of the Nyquist frequency; a cut-off frequency above this share leaves no fast part."""


def motion_frequency(motions: Motions, learn: BoolArray) -> float:
    """Return the frequency [Hz] below which the velocities of the motion have 99 % of their power.

    Every joint has the same weight, independent of its speed, and the weight of each series is its
    length. The spectrum is computed from the training rows (N,) only.

    Raises:
        DataError: No joint moves.
    """
    bridged = _bridged(motions.qd, motions, learn)
    found = (_cumulative(bridged[rows]) for rows in _spans(motions, learn))
    shares = [share for share in found if share is not None]
    if not shares:
        raise DataError(
            "no joint moves, so the frequency of the motion is undefined", hint="set f_cut_hz"
        )
    longest = max(len(share) for share in shares)
    grid = np.linspace(0.0, 1.0, longest)  # share of the Nyquist frequency
    lengths = np.array([len(share) for share in shares], dtype=np.float64)
    spread = [np.interp(grid, np.linspace(0, 1, len(s)), s) for s in shares]
    mean = np.average(spread, axis=0, weights=lengths)
    return float(0.5 * motions.rate_hz * grid[np.argmax(mean >= POWER_SHARE)])


def _bridged(values: FloatArray, motions: Motions, learn: BoolArray) -> FloatArray:
    """Return values (N, n) in which all rows but the training rows are linearly interpolated."""
    out = np.array(values, dtype=np.float64)
    for rows in _spans(motions, learn):
        at = np.arange(rows.start, rows.stop)
        known = learn[rows]
        for j in range(values.shape[1]):
            out[rows, j] = np.interp(at, at[known], values[rows, j][known])
    return out


def _spans(motions: Motions, learn: BoolArray) -> Iterator[slice]:
    """Yield, for each series, the rows from its first to its last training row."""
    for rows in motions.slices():
        known = np.flatnonzero(learn[rows])
        if len(known):
            yield slice(rows.start + int(known[0]), rows.start + int(known[-1]) + 1)


def _cumulative(qd: FloatArray) -> FloatArray | None:
    """Return the cumulative power per frequency, averaged over the moving joints, or None.

    The returned value is None if no joint moves.
    """
    window = np.hanning(len(qd) + 2)[1:-1, None]
    power = np.abs(np.fft.rfft(window * (qd - qd.mean(axis=0)), axis=0)) ** 2
    total = power.sum(axis=0)
    moving = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if not np.any(moving) or float(total.max()) == 0.0:
        return None
    share: FloatArray = np.cumsum(power[:, moving] / total[moving], axis=0).mean(axis=1)
    return share


def slow_and_fast(
    residual: FloatArray, motions: Motions, f_cut_hz: float, learn: BoolArray
) -> FloatArray:
    """Split a residual into a low-pass filtered part and the rest.

    Args:
        residual: (N, n) residual.
        motions: Motions, which define the boundaries of the series and the sample rate.
        f_cut_hz: Cut-off frequency [Hz].
        learn: (N,) mask of the training rows; the parts in training rows do not depend on any other
            row. In all rows except the training rows, only the sum of the two parts is meaningful.

    Returns:
        (2, N, n) slow part from a zero-phase filter, and fast part; the sum of both parts is the
        residual.
    """
    slow = np.array(residual, dtype=np.float64)
    fraction = f_cut_hz / (0.5 * motions.rate_hz)
    bridged = _bridged(residual, motions, learn)
    for rows in _spans(motions, learn):
        slow[rows] = _low_pass(bridged[rows], fraction)
    return np.stack([slow, residual - slow])


def _low_pass(values: FloatArray, fraction: float) -> FloatArray:
    from scipy.signal import butter, sosfiltfilt

    if fraction >= MOST_OF_NYQUIST:
        return values
    if len(values) < 2:
        return values
    # Mirror the ends over one cut-off period: with less, low cut-offs cause oscillations.
    edge = min(len(values) - 1, int(2.0 / fraction))
    filtered: FloatArray = sosfiltfilt(
        butter(ORDER, fraction, output="sos"), values, axis=0, padlen=edge
    )
    return filtered
