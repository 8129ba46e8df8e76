"""What a residual network sees and learns from: settings, motions, inputs, crops, slow and fast.

`ResidualSettings` says what the network sees, how far back, and how large it is. `Motions` holds
the series of a dataset, `NetworkInputs` scales them into the numbers that go in, `Segments` cuts
them into crops to train on. Nothing here needs torch.

`slow_and_fast` parts a residual (PINN paper, eq. 24): what is slow has the frequencies of the
motion; what is fast comes from reversals. The parts are labels to learn from: the filter may look
ahead, since nothing that predicts ever runs it. But it must not look at what is judged: it runs
from the first row of a series that is learned from to the last, and rows between them that are not
are bridged by straight lines.
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
"""Channels of a layer in each group, unless told."""

APART_HZ = 249.0
"""Instants learned from are no rarer: five times the band of motions and efforts at 50 Hz."""

MOST_SAMPLES = 100_000
"""That a network reaches back, or predicts at once: 100 s at 1 kHz, and far more than pays."""

GROUP = "residual"
"""Name of the parameters for stages and rates of training: all of them."""

TRAINING: dict[str, Any] = {
    "epochs": 60,
    "batch_size": 16,
    "learning_rate": 3e-3,
    "loss": "mse",
    "patience": 20,
}
"""What `TrainingSettings` should be for a residual network unless told; a sample is a crop."""


@dataclass(frozen=True, slots=True)
class ResidualSettings:
    """The residual network, after eq. 24–27 of the PINN paper.

    Attributes:
        inputs: `motion`: no torque. `history`: measured torque that ends `latency_s` before the
            instant it predicts. `measured`: the torque of that instant, the very quantity it is
            to predict, as the paper has it.
        latency_s: How old the newest torque of `history` is [s].
        layout: `grouped`: a network for each joint, which sees that joint alone. `joint`: one
            for all, which sees q, q̇ and q̈ of all, as in the paper.
        dilations: Steps between the taps of each layer [samples].
        kernel: Taps of each layer.
        channels: Of every layer, in each group; None: 12 grouped, 48 joint.
        activation: Of every layer.
        split: A network each for what is slow and what is fast in the residual (eq. 24). None:
            only where one network serves all joints. Joints' own networks do better without: the
            slow part alone, of a few trajectories, is soon remembered instead of understood.
        f_cut_hz: Where it is split; `auto` takes it from the spectrum of the motion.
        sign_widths: [rad/s] of the smooth signs tanh(q̇/width) that grouped networks see.
        base_input: Grouped networks see what the physical model predicts.
        crop: Instants that a training sample predicts.
        every: They are so many samples apart, while windows have every sample: neighbours of a
            filtered signal teach the same twice. It divides all dilations but the first, which
            makes the others cheap as well. None: as far apart as `APART_HZ` allows.
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
                hint="give fewer or smaller dilations",
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
        object.__setattr__(self, name, value)  # what counts must be an int, not 5.0

    @property
    def window(self) -> int:
        """Samples an output depends on, the newest among them: l of eq. 25."""
        return 1 + (self.kernel - 1) * sum(self.dilations)

    @property
    def width(self) -> int:
        """Channels of a layer in each group."""
        return CHANNELS[self.layout] if self.channels is None else self.channels

    @property
    def branches(self) -> int:
        """Networks whose outputs are added: slow and fast, or one for both."""
        return 2 if self.parted else 1

    @property
    def parted(self) -> bool:
        """True if slow and fast have networks of their own."""
        return self.layout == "joint" if self.split is None else self.split

    @property
    def protocol(self) -> str:
        """`honest`, with the least age of the torque it hears, or how it departs from that.

        It is older where the latency is no whole number of samples.
        """
        if self.inputs == "measured":
            return "paper: measured torque among the inputs"
        if self.inputs == "history":
            return f"honest: torque history ending at least {1e3 * self.latency_s:g} ms before"
        return "honest"

    def lag(self, rate_hz: float) -> int:
        """Samples between the newest torque that is heard and the instant predicted."""
        # A hair is taken off so that 20 ms at 1 kHz are 20 samples however the rate is rounded.
        samples = -int(-self.latency_s * rate_hz * (1.0 - 1e-6) // 1)
        return max(1, samples) if self.inputs == "history" else 0

    def apart(self, rate_hz: float) -> int:
        """Samples between instants that are learned from."""
        if self.every is not None:
            return self.every
        fits = [k for k in range(1, self._common + 1) if self._common % k == 0]
        return max(k for k in fits if k == 1 or rate_hz / k >= APART_HZ)

    @property
    def _common(self) -> int:
        """Largest number that divides all dilations but the first; 1 without any."""
        return max(1, gcd(*self.dilations[1:]))

    def to_json(self) -> dict[str, Any]:
        """All settings, as `given` reads them."""
        return asdict(self)

    @staticmethod
    def given(settings: dict[str, Any]) -> ResidualSettings:
        """From keyword arguments; lists stand for tuples.

        Raises:
            SpecError: There is no such setting, or it cannot have that value.
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
"""Difference of sample rates, as a share, beyond which a network's memory means another time."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Series of evenly spaced samples of n joints.

    Attributes:
        q, qd, qdd: (N, n) [rad, rad/s, rad/s²].
        base: (N, n) effort the physical model predicts.
        effort: (N, n) measured effort that may be heard, in the unit of `base`; None without.
        offsets: (S + 1,) row at which each series begins; the last entry is N.
        rate_hz: Samples per second of the series that move.
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
        """Of a dataset with filtered columns, no rows left out.

        A history of torque is taken as recorded: a filter without phase shift would bring what
        comes later into what has been. The paper's `measured` torque is the filtered one.

        Args:
            dataset: Prepared (`hil.data.prepare`).
            base: (N, n) what the physical model predicts for its rows, in its unit of effort.
            settings: Which torque is heard.

        Raises:
            DataError: Nothing moves, or series are sampled at different rates.
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
        """The rows of each series that has any."""
        for start, stop in pairwise(self.offsets.tolist()):
            if stop > start:
                yield slice(start, stop)

    def heard(self, settings: ResidualSettings) -> FloatArray | None:
        """(N, n) torque as each row hears it, NaN where none has arrived; None: it hears none.

        A joint's own network hears what the physical model left then; one for all joints hears
        the torque.

        Raises:
            DataError: It should hear a torque, and there is none.
        """
        if settings.inputs == "motion":
            return None
        if self.effort is None:
            raise DataError(
                f"inputs: {settings.inputs} needs the measured torque, but none was given",
                hint="give recordings with an effort, or choose inputs: motion",
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
    """Samples per second of the series that move; those at rest may have any rate.

    Raises:
        DataError: Nothing moves for at least two samples, or two series differ by more than 5 %.
    """
    rates = motion_rates(dataset)
    if not rates:
        raise DataError(
            "a residual network needs a motion of at least two samples, but there is none",
            hint="give trajectories",
        )
    (low, slow), (high, quick) = min(rates), max(rates)
    if high > (1.0 + RATE_TOLERANCE) * low:
        raise DataError(
            f"{slow} is sampled at {low:.4g} Hz and {quick} at {high:.4g} Hz, but the memory of "
            "a residual network counts samples",
            hint="use recordings of one rate",
        )
    return float(np.median([rate for rate, _ in rates]))


def require_one_rate(data: Dataset) -> None:
    """Refuse series sampled at different rates: a network's memory counts samples.

    Raises:
        FitError: Two series differ by more than 5 %, or nothing moves.
    """
    try:
        one_rate(data)
    except DataError as error:
        raise FitError(error.message, hint=error.hint) from error


def in_motion(data: Dataset) -> BoolArray:
    """(N,) rows of series that move: networks know nothing of arms at rest."""
    moving = np.zeros(len(data), dtype=bool)
    for condition, rows in data.slices():
        moving[rows] = condition.kind not in AT_REST
    return moving


def trajectory_numbers(data: Dataset) -> IntArray:
    """(N,) number of the trajectory of every row, the same whatever the load."""
    known = [group_of(condition, "trajectory") for condition in data.conditions]
    keys = [("series", i) if group is None else group for i, group in enumerate(known)]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)[data.series_index()]


TINY = 1e-9
"""Added to scales: a joint that never moved is divided by something."""


@dataclass(frozen=True, slots=True, eq=False)
class InputScales:
    """Means and deviations of the rows learned from, (n,) each, and the range of the inputs.

    Beyond the range it was trained in nobody knows what a network says: inputs are held at its
    ends.

    Attributes:
        q_mean, q, qd, qdd, base_mean, base, heard_mean, heard: Means, and deviations to divide by.
        lowest, highest: (G, F) of the scaled inputs.
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
        """By name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: ResidualSettings, n: int
    ) -> InputScales:
        """Inverse of `to_arrays`, for n joints.

        Raises:
            DataError: An array is missing or has another shape.
        """
        shapes: dict[str, tuple[int, ...]] = {f.name: (n,) for f in fields(InputScales)}
        shapes |= dict.fromkeys(("lowest", "highest"), group_shape(settings, n))
        for name, shape in shapes.items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != shape:
                raise DataError(
                    f"the residual network's scale {name} has shape {found}, not {shape}"
                )
        return InputScales(**{name: np.asarray(arrays[name]) for name in shapes})


def group_shape(settings: ResidualSettings, n: int) -> tuple[int, int]:
    """(G, F): groups of inputs, and how many each sees."""
    heard = int(settings.inputs != "motion")
    if settings.layout == "joint":
        return 1, n * (3 + heard)
    return n, 2 + len(settings.sign_widths) + int(settings.base_input) + heard


class NetworkInputs:
    """Inputs by layout: G groups of F numbers, every joint its own or one group for all.

    Args:
        settings: Which inputs.
        scales: From `scaled_to`, or of a stored network.
    """

    def __init__(self, settings: ResidualSettings, scales: InputScales) -> None:
        self.settings = settings
        self.scales = scales

    @staticmethod
    def scaled_to(motions: Motions, rows: BoolArray, settings: ResidualSettings) -> NetworkInputs:
        """Inputs scaled by the rows (N,) to be learned from."""
        n = motions.n
        heard = motions.heard(settings)
        heard = np.zeros((len(motions), n)) if heard is None else heard
        known = heard[rows & np.all(np.isfinite(heard), axis=1)]
        known = known if len(known) else np.zeros((1, n))
        scales = InputScales(
            q_mean=motions.q[rows].mean(axis=0),
            q=motions.q[rows].std(axis=0) + TINY,
            # Velocities and accelerations keep their zero: it means rest.
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
        """(N, G, F) for every row."""
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
        """(N, G, F) from arrays (N, n); `heard` as `Motions.heard` has it."""
        by_joint = self._grouped(qd, qdd, base) if self._own else self._joint(q, qd, qdd)
        if heard is not None:
            scaled = (heard - self.scales.heard_mean) / self.scales.heard
            # What has not arrived yet is taken for the mean.
            by_joint.append(np.where(np.isfinite(scaled), scaled, 0.0))
        # (N, n, F) as it is, or all joints' numbers one behind the other.
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
"""In place of a row: the series has ended."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Where crops lie in arrays whose series have `window - 1` rows of their first row before.

    Attributes:
        padded: (P,) row of the recording that each padded row holds.
        starts: (C,) padded row at which each crop's first window begins.
        rows: (C, crop) row of the recording each output of a crop is for.
        counted: (C, crop) true where that output is learned from or judged.
        every: Rows between outputs.
    """

    padded: IntArray
    starts: IntArray
    rows: IntArray
    counted: BoolArray
    every: int

    @staticmethod
    def of(motions: Motions, counted: BoolArray, settings: ResidualSettings) -> Segments:
        """Crops that tile every series and hold rows (N,) that count.

        Neighbouring crops begin their instants a row apart, so that no phase is left out. What is
        behind the end of a series is held at its last row and not counted.
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
        """(B, (crop - 1)·every + window) padded rows that go into the crops (B,)."""
        length = (settings.crop - 1) * self.every + settings.window
        return np.asarray(self.starts[numbers, None] + np.arange(length))


def sizes(parts: FloatArray, rows: BoolArray) -> FloatArray:
    """(branches, n) root mean square of each part over the rows that are learned from."""
    root: FloatArray = np.sqrt(np.mean(parts[:, rows] ** 2, axis=1))
    # A part that is nothing is learned as nothing.
    return np.where(root > 0.0, root, 1.0)


POWER_SHARE = 0.99
"""Of the joints' velocities that lies below the motion's highest frequency."""

ORDER = 2
"""Of the Butterworth filter, forwards and backwards."""

MOST_OF_NYQUIST = 0.8
"""A cut-off above leaves nothing that is fast."""


def motion_frequency(motions: Motions, learn: BoolArray) -> float:
    """The frequency [Hz] below which the motion's velocities have 99 % of their power.

    Every joint counts alike, however quick it is; series are weighted by their length. Only rows
    that are learned from (N,) have a say.

    Raises:
        DataError: Nothing moves.
    """
    bridged = _bridged(motions.qd, motions, learn)
    found = (_cumulative(bridged[rows]) for rows in _spans(motions, learn))
    shares = [share for share in found if share is not None]
    if not shares:
        raise DataError("no joint moves, so the motion has no frequency", hint="set f_cut_hz")
    longest = max(len(share) for share in shares)
    grid = np.linspace(0.0, 1.0, longest)  # of the Nyquist frequency
    lengths = np.array([len(share) for share in shares], dtype=np.float64)
    spread = [np.interp(grid, np.linspace(0, 1, len(s)), s) for s in shares]
    mean = np.average(spread, axis=0, weights=lengths)
    return float(0.5 * motions.rate_hz * grid[np.argmax(mean >= POWER_SHARE)])


def _bridged(values: FloatArray, motions: Motions, learn: BoolArray) -> FloatArray:
    """(N, n) with straight lines where rows within a span are not learned from."""
    out = np.array(values, dtype=np.float64)
    for rows in _spans(motions, learn):
        at = np.arange(rows.start, rows.stop)
        known = learn[rows]
        for j in range(values.shape[1]):
            out[rows, j] = np.interp(at, at[known], values[rows, j][known])
    return out


def _spans(motions: Motions, learn: BoolArray) -> Iterator[slice]:
    """From the first row to the last that is learned from, of each series that has any."""
    for rows in motions.slices():
        known = np.flatnonzero(learn[rows])
        if len(known):
            yield slice(rows.start + int(known[0]), rows.start + int(known[-1]) + 1)


def _cumulative(qd: FloatArray) -> FloatArray | None:
    """Share of power up to each frequency, mean over the joints that move; None if none does."""
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
    """(2, N, n): what a zero-phase low-pass filter lets through, and the rest; they add up.

    Args:
        residual: (N, n).
        motions: Says where series begin and how fast they were sampled.
        f_cut_hz: Cut-off [Hz].
        learn: (N,) rows to learn from: their parts depend on no other row. Parts of the others
            are good for nothing but their sum.
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
    # The ends are mirrored over a period of the cut-off: a shorter edge swings at slow cut-offs.
    edge = min(len(values) - 1, int(2.0 / fraction))
    filtered: FloatArray = sosfiltfilt(
        butter(ORDER, fraction, output="sos"), values, axis=0, padlen=edge
    )
    return filtered
