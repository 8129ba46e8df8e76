"""How a Lagrangian network, its friction and its training are set up; nothing here needs torch.

`NetworkSettings` is the network behind M(q) and g(q), `FrictionSettings` the friction beside it;
both have a `literal()` that takes the PINN paper at its word. `Design` holds the two: with weights
and torque scales it is the model. The functions below make designs, trainings and stages from the
parameters of the estimator `lagrangian`.
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
"""Lists of a YAML file become tuples."""


class NetworkSettings(BaseModel):
    """Structure and start of the network behind M(q) and g(q).

    Attributes:
        hidden: Units of each hidden layer, one layer at least.
        activation: Of the hidden layers. The torque holds its derivative: where that jumps (relu),
            so does the torque.
        features: What the first layer sees: `sincos` [cos q, sin q], the same after a whole turn,
            or `raw` q [rad].
        gravity: `potential` learns V(q) and takes its gradient, `head` learns g(q) itself, which
            need not be the gradient of anything.
        diagonal: What keeps the diagonal of the factor L of M = LLᵀ from below zero. With `relu`
            an entry can stay 0 for ever.
        epsilon: Keeps M from being singular.
        epsilon_of: What it is added to: the diagonal of the `factor`, or that of the `mass` matrix.
        scaled: Give row j of L the unit √(torque scale of joint j), and V the largest one, so that
            every joint starts with torques of its own size.
        hidden_gain: Standard deviation of hidden layers' first weights over Glorot's.
        output_gain: The same for the last layer.
        bias: First value of every bias …
        diagonal_bias: … but those of L's diagonal.
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
        """What the paper prints (Section II.B, III.A): ReLU, q as it is, g(q) as a head of its own.

        What it leaves open is as in the code that DeLaN's authors published: start weights, start
        biases, and 10⁻⁵ added to M.
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
"""Methods 4 (none), 6 (Coulomb–viscous), Proposed (Stribeck) and both forms of 5."""

Sign: TypeAlias = Literal["given", "hard"]
Bounds: TypeAlias = tuple[float, float]

BOUNDED = {
    "speed_bounds": "start_speed",
    "shape_bounds": "start_shape",
    "exponent_bounds": "start_exponent",
}
"""Bounds → where the parameter within them starts."""


@dataclass(frozen=True, slots=True)
class FrictionSettings:
    """How friction is parametrised.

    Bounds and unit are not taste: v_s, δ_s and α make up for each other, and without bounds end
    where no joint is; and coefficients in plain N·m move so slowly beside the network's weights
    that the network learns friction as gravity first.

    Attributes:
        sign: `given`: the direction the caller hands over (smooth sign, or Dahl's state); `hard`:
            sign(q̇) of the paper, whatever is handed over.
        scaled: Coefficients have `unit` times the joint's torque for a unit, and networks its
            torque; otherwise 1 N·m.
        unit: Share of the joint's standard deviation of torque, and what f_s, f_c, f_v start at.
        start: What they start at without `scaled` [N·m].
        bounded: f_s, f_c, f_v ≥ 0 and v_s, δ_s, α within their bounds.
        speed_bounds: Of v_s [rad/s].
        shape_bounds: Of δ_s.
        exponent_bounds: Of α.
        start_speed, start_shape, start_exponent: What v_s, δ_s, α start at.
        offset: Stribeck friction has a constant beside eq. 18 (of sensors and drives: the one part
            that is not passive). Coulomb–viscous friction has one by definition, eq. 3.
        hidden: Widths of the hidden layers of a dissipative or an unconstrained network.
        rest_speed: Below about this speed [rad/s] the damping of a dissipative network no longer
            grows as speed falls. An estimator hands over the width of its smooth sign.
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
        """As the paper says: hard sign, N·m, free parameters, no offset."""
        return FrictionSettings(
            sign="hard", scaled=False, bounded=False, offset=False,
            start_speed=0.1, start_shape=1.0, start_exponent=1.0,
        )  # fmt: skip

    @staticmethod
    def given(settings: dict[str, Any]) -> FrictionSettings:
        """From keyword arguments, as a spec has them.

        Raises:
            SpecError: There is no such setting, or it cannot have that value.
        """
        require_known(settings, tuple(f.name for f in fields(FrictionSettings)), "friction")
        return FrictionSettings(**settings)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # lists of a YAML file become tuples


def _bounds(name: str, value: Any) -> Bounds:
    pair = _sequence(name, value)
    if len(pair) != 2:
        raise SpecError(f"{name} is {value!r}, but must be the lowest and the highest value")
    low, high = (number(name, limit, above=0.0) for limit in pair)
    if low >= high:
        raise SpecError(f"{name} is {value!r}, but the first must be below the second")
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
"""Where training differs from its defaults, the same for every friction. By the error on held-out
trajectories of a simulated UR5, in torque deviations, SMAPE with a floor, Huber's loss and the
absolute error give .140/.129/.132 with Stribeck friction, .150/.147/.146 with Coulomb's and
.174/.657/.174 with a dissipative network, which Huber's left in a bad minimum for one seed of two.
Best epochs came late: more of them would gain a little."""

FRICTION_RATES: Mapping[FrictionKind, tuple[float, ...]] = {"dissipative": (1.0, 0.2)}
"""Where more than one learning rate of the friction is tried, as shares of the usual one; the
training that validates better is kept. A dissipative network learns poses by heart when data are
few: on four trajectories of a UR10e, each left out once, choosing takes the mean error from 0.54 to
0.41 A; on nine of a simulated UR5 the usual rate is better by a fifth, and is chosen. A network of
(q, qd) gains nothing by it: 0.86 instead of 0.79 A, and 3.70 instead of 3.76 N·m."""


@dataclass(frozen=True, slots=True)
class Design:
    """What a network looks like; with its weights and torque scales it is the model.

    Attributes:
        kind: Of the friction.
        network: The Lagrangian part.
        friction: How the friction is parametrised.
    """

    kind: FrictionKind
    network: NetworkSettings
    friction: FrictionSettings

    def facts(self) -> dict[str, Any]:
        """As JSON, for the model file: defaults of a later hil may be others."""
        return {
            "kind": self.kind,
            "network": self.network.model_dump(),
            "friction": asdict(self.friction),
        }

    @staticmethod
    def restored(facts: Mapping[str, Any]) -> Design:
        """Inverse of `facts`.

        Raises:
            KeyError, TypeError, SpecError: Something is missing or cannot be.
        """
        network = settings("network", facts["network"], NetworkSettings)
        return Design(facts["kind"], network, FrictionSettings.given(dict(facts["friction"])))


def design(
    kind: FrictionKind,
    protocol: str,
    network: Mapping[str, Any],
    friction: Mapping[str, Any] | None = None,
) -> Design:
    """Return the design that a protocol stands for, with some settings changed.

    Args:
        kind: Of the friction.
        protocol: Whose settings.
        network: Settings of the network that differ.
        friction: Settings of the friction that differ.

    Raises:
        SpecError: A setting is unknown or cannot be.
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
    """The training a protocol stands for, with some settings changed.

    Raises:
        SpecError: A setting is unknown or cannot be.
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
    """Return the trainings of which the one that validates best is kept; one if rates are given."""
    given = training.group_rates

    def with_rates(rates: dict[str, float]) -> TrainingSettings:
        return training.model_copy(update={"group_rates": rates})

    if kind == "none":  # without parameters there is nothing that a rate of theirs could be for
        return (with_rates({name: rate for name, rate in given.items() if name != FRICTION}),)
    if protocol == "paper" or FRICTION in given:
        return (training,)
    return tuple(
        training if rate == 1.0 else with_rates({**given, FRICTION: rate})
        for rate in FRICTION_RATES.get(kind, (1.0,))
    )


def require_agreement(protocol: str, direction: str, friction: FrictionSettings) -> None:
    """Refuse a friction state that a hard sign, such as the paper's, would leave unused.

    Raises:
        SpecError: Both are asked for.
    """
    if friction.sign == "hard" and direction == "dahl":
        paper = protocol == "paper"
        whose = "protocol is 'paper', whose friction has" if paper else "friction_settings has"
        raise SpecError(
            f"{whose} a hard sign, but direction is 'dahl'",
            hint=f"use {'protocol: ours' if paper else 'sign: given'} with a state, or "
            "direction: smooth",
        )


def stages(learning: str, kind: FrictionKind, training: TrainingSettings) -> tuple[Stage, ...]:
    """Algorithm 1, or everything at once; without friction there is nothing to freeze."""
    if learning == "joint" or kind == "none":
        return joint_stages(training)
    return hybrid_stages(training)


CUTOFF_HZ, KEPT_HZ = 50.0, 125.0
"""Of recordings that are fast enough: the paper's filters, and the rows left afterwards."""

FAST_HZ = 150.0
"""Slower recordings get the filters of the other estimators, and keep every row."""


def filters_for(dataset: Dataset) -> FilterSettings:
    """Filters by the rate of the slowest motion."""
    slowest = min((rate for rate, _ in motion_rates(dataset)), default=0.0)
    if slowest < FAST_HZ:
        return FilterSettings()
    cuts = dict.fromkeys(("velocity", "acceleration", "effort"), CUTOFF_HZ)
    every = max(1, int(slowest // KEPT_HZ))
    return FilterSettings.model_validate({"unit": "hz", "every": every, **cuts})
