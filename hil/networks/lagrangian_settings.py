"""Settings of a Lagrangian network, of its friction and of its training; independent of torch.

`NetworkSettings` describes the network that yields M(q) and g(q), `FrictionSettings` describes the
friction model. `NetworkSettings` and `FrictionSettings` each have a method `literal()` that returns
exactly the settings of the PINN paper. `Design` combines network settings and friction settings; a
design with weights and torque scales is a complete model. The functions of this module create
designs, training settings and stages from the parameters of the estimator `lagrangian`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hil.core import SpecError
from hil.data import Dataset, FilterSettings, motion_rates
from hil.estimators import Whole, choice, flag, number, require_known, settings, whole
from hil.networks.training import (
    DYNAMICS,
    FRICTION,
    Stage,
    TrainingSettings,
    hybrid_stages,
    joint_stages,
    require_groups,
)

Activation = Literal["softplus", "relu", "tanh", "silu"]
Gain = Annotated[float, Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False)]

Layers = Annotated[
    tuple[Annotated[Whole, Field(strict=True, ge=1, le=4096)], ...], Field(strict=False)
]
"""Number of units per hidden layer; lists from a YAML file are converted to tuples."""


class NetworkSettings(BaseModel):
    """Structure and start weights of the network that yields M(q) and g(q).

    Attributes:
        hidden: Number of units of each hidden layer; there is at least one hidden layer.
        activation: Activation function of the hidden layers. The torque contains the derivative of
            the activation function. With `relu` the derivative of the activation has jumps, so the
            torque has jumps too.
        features: Inputs of the first layer: `sincos` [cos q, sin q], which is periodic, or `raw` q
            [rad].
        gravity: `potential` learns V(q) and uses its gradient; `head` learns g(q) directly, which
            is then not necessarily the gradient of a potential.
        diagonal: Activation that keeps the diagonal of the factor L of M = LLᵀ non-negative. With
            `relu` an entry of the diagonal can stay at 0 permanently.
        epsilon: Constant that keeps M from being singular.
        epsilon_of: Matrix to whose diagonal `epsilon` is added: `factor` for L, `mass` for M.
        scaled: Whether row j of L has the unit √(torque scale of joint j) and V has the largest of
            the torque scales as unit; every joint then starts with torques of its typical size.
        hidden_gain: Standard deviation of the start weights of hidden layers, relative to Glorot's.
        output_gain: Standard deviation of the start weights of the last layer, relative to
            Glorot's.
        bias: Start value of every bias except those of the diagonal of L.
        diagonal_bias: Start value of the biases of the diagonal of L.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    hidden: Layers = (128, 128, 128)
    activation: Activation = "softplus"
    features: Literal["sincos", "raw"] = "sincos"
    gravity: Literal["potential", "head"] = "potential"
    diagonal: Literal["softplus", "relu"] = "softplus"
    epsilon: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 1e-3
    epsilon_of: Literal["factor", "mass"] = "factor"
    scaled: bool = True
    hidden_gain: Gain = 1.0
    output_gain: Gain = 0.3
    bias: Finite = 0.0
    diagonal_bias: Finite = 0.5

    @field_validator("hidden")
    @classmethod
    def _has_a_layer(cls, hidden: tuple[int, ...]) -> tuple[int, ...]:
        if not 1 <= len(hidden) <= 16:
            raise ValueError("a network has 1 to 16 hidden layers")
        return hidden

    @classmethod
    def literal(cls) -> NetworkSettings:
        """Return the settings of the PINN paper: ReLU, raw q, g(q) as a separate head.

        The returned settings are those of Sections II.B and III.A of the PINN paper. Start weights,
        start biases and the 10⁻⁵ added to M are not stated in the PINN paper; the values are those
        of the code published by the authors of DeLaN.
        """
        return cls(
            activation="relu",
            features="raw",
            gravity="head",
            diagonal="relu",
            epsilon=1e-5,
            epsilon_of="mass",
            scaled=False,
            hidden_gain=2.0**0.5,
            output_gain=2.0**0.5,
            bias=0.1,
            diagonal_bias=0.1,
        )


FrictionKind: TypeAlias = Literal["none", "coulomb", "stribeck", "dissipative", "unconstrained"]

FRICTIONS: tuple[FrictionKind, ...] = (
    "none",
    "coulomb",
    "stribeck",
    "dissipative",
    "unconstrained",
)
"""Friction models of the PINN paper: method 4 (none), 6, Proposed (Stribeck), 5 (two variants)."""

Sign: TypeAlias = Literal["given", "hard"]
Bounds: TypeAlias = tuple[float, float]

BOUNDED = {
    "speed_bounds": "start_speed",
    "shape_bounds": "start_shape",
    "exponent_bounds": "start_exponent",
}
"""Mapping from the setting with the bounds of a parameter to the setting with its start value."""


@dataclass(frozen=True, slots=True)
class FrictionSettings:
    """Parametrisation of the friction: bounds, units and start values of the parameters.

    Bounds are necessary because v_s, δ_s and α compensate each other. Without bounds, the training
    ends at values of v_s, δ_s and α that no real joint has. A suitable unit is necessary because
    coefficients in N·m change slowly compared with the weights of the network. Without the unit,
    the network first learns friction as gravity.

    Attributes:
        sign: Direction in the friction law: `given` or `hard`. With `given` the law uses the
            direction that the caller passes (smooth sign or Dahl's state). With `hard` the law uses
            sign(q̇) as in the PINN paper and ignores the passed direction.
        scaled: Whether the unit of coefficients is `unit` times the standard deviation of the
            joint's torque, and the unit of the outputs of friction networks is that standard
            deviation; if false, both units are 1 N·m.
        unit: Unit of the coefficients as a share of the standard deviation of the joint's torque;
            f_s, f_c and f_v start at this unit.
        start: Start value of f_s, f_c and f_v if `scaled` is false [N·m].
        bounded: Whether f_s, f_c and f_v are kept ≥ 0, and v_s, δ_s and α within their bounds.
        speed_bounds: Bounds of v_s [rad/s].
        shape_bounds: Bounds of δ_s.
        exponent_bounds: Bounds of α.
        start_speed, start_shape, start_exponent: Start values of v_s [rad/s], δ_s and α.
        offset: Whether Stribeck friction has a constant torque in addition to eq. 18. The constant
            torque represents errors of sensors and drives, and is the only part of the friction
            model that is not passive. Coulomb–viscous friction always has a constant torque (eq.
            3).
        hidden: Number of units of each hidden layer of a dissipative or unconstrained network.
        rest_speed: Speed [rad/s] below which the damping of a dissipative network stops growing.
            The estimator `lagrangian` passes the width of its smooth sign as `rest_speed`.
    """

    sign: Sign = "given"
    scaled: bool = True
    unit: float = 0.3
    start: float = 0.1
    bounded: bool = True
    speed_bounds: Bounds = (0.02, 0.3)
    shape_bounds: Bounds = (0.5, 2.5)
    exponent_bounds: Bounds = (0.5, 1.2)
    start_speed: float = 0.08
    start_shape: float = 1.2
    start_exponent: float = 0.8
    offset: bool = True
    hidden: tuple[int, ...] = (128, 128)
    rest_speed: float = 0.01

    def __post_init__(self) -> None:
        choice("sign", self.sign, ("given", "hard"))
        for name in ("scaled", "bounded", "offset"):
            flag(name, getattr(self, name))
        for name in ("unit", "start", "start_speed", "start_shape", "start_exponent"):
            self._set(name, number(name, getattr(self, name), above=0.0))
        self._set("rest_speed", number("rest_speed", self.rest_speed, at_least=0.0))
        for pair, start in BOUNDED.items():
            self._set(pair, _bounds(pair, getattr(self, pair)))
            if self.bounded:
                _require_inside(start, getattr(self, start), pair, getattr(self, pair))
        widths = _sequence("hidden", self.hidden)
        self._set(
            "hidden", tuple(whole("hidden", width, at_least=1, at_most=4096) for width in widths)
        )

    @staticmethod
    def literal() -> FrictionSettings:
        """Return the PINN paper's settings: hard sign, N·m, unbounded parameters, no offset."""
        return FrictionSettings(
            sign="hard", scaled=False, bounded=False, offset=False,
            start_speed=0.1, start_shape=1.0, start_exponent=1.0,
        )  # fmt: skip

    @staticmethod
    def given(settings: dict[str, Any]) -> FrictionSettings:
        """Return friction settings from the keyword arguments of a spec.

        Raises:
            SpecError: A setting is unknown or has an invalid value.
        """
        require_known(settings, tuple(f.name for f in fields(FrictionSettings)), "friction")
        return FrictionSettings(**settings)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # converts lists from a YAML file to tuples


def _bounds(name: str, value: Any) -> Bounds:
    pair = _sequence(name, value)
    if len(pair) != 2:
        raise SpecError(
            f"{name} is {value!r}, but must be a list of two numbers: the lowest and "
            "the highest value"
        )
    low, high = (number(name, limit, above=0.0) for limit in pair)
    if low >= high:
        raise SpecError(f"{name} is {value!r}, but the first number must be below the second")
    return low, high


def _sequence(name: str, value: Any) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise SpecError(f"{name} is {value!r}, but must be a list of numbers")
    return tuple(value)


def _require_inside(name: str, value: float, pair: str, bounds: Bounds) -> None:
    low, high = bounds
    if not low < value < high:
        raise SpecError(
            f"{name} is {value:g}, but must be between {low:g} and {high:g}",
            hint=f"change {name}, or {pair}",
        )


PROTOCOLS = ("ours", "paper")
LEARNING = ("hybrid", "joint")
DIRECTIONS = ("smooth", "dahl")

LAGRANGIAN_CHOICES: Mapping[str, Any] = {"loss": "mae", "epochs": 60}
"""Training settings that differ from the defaults; the same for every friction model.

The loss was selected by the prediction error on held-out trajectories of a simulated UR5, in torque
standard deviations. SMAPE with a floor, Huber's loss and the absolute error give prediction errors
of .140/.129/.132 with Stribeck friction, .150/.147/.146 with Coulomb friction and .174/.657/.174
with a dissipative network. With the dissipative network, training with Huber's loss ended in a poor
minimum for one of two seeds. The epochs with the lowest error were late, so training for more
epochs would give a small improvement.
"""

FRICTION_RATES: Mapping[FrictionKind, tuple[float, ...]] = {"dissipative": (1.0, 0.2)}
"""Learning rates of the friction, as shares of the default rate, for a choice between rates.

One network is trained for each rate, and the network with the lower validation error is selected.
With few data, a dissipative network overfits to poses at the default rate. On four trajectories of
a UR10e, each held out in turn, the selection of the rate reduces the mean error from 0.54 to 0.41
A. On nine trajectories of a simulated UR5 the error with the default rate is lower by a fifth, and
the default rate is selected. A lower rate does not improve an unconstrained network of (q, qd): the
mean error is 0.86 instead of 0.79 A, and 3.70 instead of 3.76 N·m.
"""


@dataclass(frozen=True, slots=True)
class Design:
    """Design of a network; a design with weights and torque scales is the complete model.

    Attributes:
        kind: Friction model.
        network: Settings of the Lagrangian part.
        friction: Parametrisation of the friction.
    """

    kind: FrictionKind
    network: NetworkSettings
    friction: FrictionSettings

    def facts(self) -> dict[str, Any]:
        """Return the design as JSON for the model file; defaults may change in later versions."""
        return {
            "kind": self.kind,
            "network": self.network.model_dump(),
            "friction": asdict(self.friction),
        }

    @staticmethod
    def restored(facts: Mapping[str, Any]) -> Design:
        """Return the design from the result of `facts`.

        Raises:
            KeyError, TypeError, SpecError: An entry of the design is missing or invalid.
        """
        network = settings("network", facts["network"], NetworkSettings)
        return Design(facts["kind"], network, FrictionSettings.given(dict(facts["friction"])))


def design(
    kind: FrictionKind,
    protocol: str,
    network: Mapping[str, Any],
    friction: Mapping[str, Any] | None = None,
) -> Design:
    """Return the design of a protocol, with the passed settings changed.

    Args:
        kind: Friction model.
        protocol: Protocol that defines the default settings.
        network: Mapping of network settings that differ from the defaults.
        friction: Mapping of friction settings that differ from the defaults.

    Raises:
        SpecError: A setting is unknown or has an invalid value.
    """
    paper = protocol == "paper"
    usual_friction = FrictionSettings.literal() if paper else FrictionSettings()
    try:
        chosen = FrictionSettings.given(asdict(usual_friction) | dict(friction or {}))
    except SpecError as error:
        raise SpecError(f"friction_settings: {error.message}", hint=error.hint) from error
    usual = NetworkSettings.literal() if paper else NetworkSettings()
    changed = settings("network", usual.model_dump() | dict(network), NetworkSettings)
    return Design(kind, changed, chosen)


def training_settings(
    protocol: str, loops: int, seed: int, changed: Mapping[str, Any]
) -> TrainingSettings:
    """Return the training settings of a protocol, with the passed settings changed.

    Raises:
        SpecError: A setting is unknown or has an invalid value.
    """
    paper = protocol == "paper"
    start = (
        TrainingSettings.literal() if paper else TrainingSettings.model_validate(LAGRANGIAN_CHOICES)
    )
    given = start.model_dump() | {"loops": loops, "seed": seed} | dict(changed)
    training = settings("training", given, TrainingSettings)
    require_groups("training.group_rates has", training.group_rates, (DYNAMICS, FRICTION))
    return training


def trials(
    kind: FrictionKind, protocol: str, training: TrainingSettings
) -> tuple[TrainingSettings, ...]:
    """Return the training settings to try; a single entry if the friction rate is specified.

    The caller trains with each entry and selects the network with the lowest validation error.
    """
    given = training.group_rates

    def with_rates(rates: dict[str, float]) -> TrainingSettings:
        return training.model_copy(update={"group_rates": rates})

    if kind == "none":  # zero friction has no parameters, so it has no learning rate
        return (with_rates({name: rate for name, rate in given.items() if name != FRICTION}),)
    if protocol == "paper" or FRICTION in given:
        return (training,)
    return tuple(
        training if rate == 1.0 else with_rates({**given, FRICTION: rate})
        for rate in FRICTION_RATES.get(kind, (1.0,))
    )


def require_agreement(protocol: str, direction: str, friction: FrictionSettings) -> None:
    """Raise if Dahl's state is requested but the friction has a hard sign, which ignores it.

    Raises:
        SpecError: The friction has a hard sign and `direction` is `dahl`.
    """
    if friction.sign == "hard" and direction == "dahl":
        paper = protocol == "paper"
        whose = "protocol is 'paper', whose friction has" if paper else "friction_settings has"
        raise SpecError(
            f"{whose} a hard sign, but direction is 'dahl'",
            hint=f"set {'protocol: ours' if paper else 'sign: given'} for Dahl's state, or "
            "direction: smooth",
        )


def stages(learning: str, kind: FrictionKind, training: TrainingSettings) -> tuple[Stage, ...]:
    """Return the stages of Algorithm 1 of the PINN paper, or a single joint stage.

    There is a single joint stage if `learning` is `joint`, or if the friction is `none` and there
    is no friction to freeze.
    """
    if learning == "joint" or kind == "none":
        return joint_stages(training)
    return hybrid_stages(training)


CUTOFF_HZ, KEPT_HZ = 50.0, 125.0
"""Cut-off frequency of the PINN paper, and training rows per second, for fast recordings [Hz]."""

FAST_HZ = 150.0
"""Sample rate [Hz] below which a recording gets the default filters and retains every row."""


def filters_for(dataset: Dataset) -> FilterSettings:
    """Return filter settings that suit the sample rate of the slowest motion."""
    slowest = min((rate for rate, _ in motion_rates(dataset)), default=0.0)
    if slowest < FAST_HZ:
        return FilterSettings()
    cuts = dict.fromkeys(("velocity", "acceleration", "effort"), CUTOFF_HZ)
    every = max(1, int(slowest // KEPT_HZ))
    return FilterSettings.model_validate({"unit": "hz", "every": every, **cuts})
