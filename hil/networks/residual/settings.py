"""What a residual network sees, how far back, and how large it is; checked before it is built."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from math import gcd
from typing import Any, Literal, get_args

from hil.core import SpecError
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
