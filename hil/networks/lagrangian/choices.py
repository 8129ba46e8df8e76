"""From an estimator's parameters to the settings of its network, friction and training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hil.core import SpecError
from hil.data import Dataset, FilterSettings, motion_rates
from hil.estimators import settings
from hil.networks.lagrangian.friction_settings import FrictionKind, FrictionSettings
from hil.networks.lagrangian.settings import NetworkSettings
from hil.networks.training import (
    DYNAMICS,
    FRICTION,
    Stage,
    TrainingSettings,
    hybrid_stages,
    joint_stages,
    require_groups,
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
    friction: FrictionSettings | None = None,
) -> Design:
    """The design a protocol stands for, with some settings of the network changed.

    Args:
        kind: Of the friction.
        protocol: Whose settings.
        network: Settings of the network that are to be others.
        friction: By default that of the protocol.

    Raises:
        SpecError: A setting is unknown or cannot be.
    """
    paper = protocol == "paper"
    start = NetworkSettings.literal() if paper else NetworkSettings()
    changed = settings("network", start.model_dump() | dict(network), NetworkSettings)
    usual = FrictionSettings.literal() if paper else FrictionSettings()
    return Design(kind, changed, friction or usual)


def friction_settings(
    protocol: str, sign_width: float, changed: Mapping[str, Any]
) -> FrictionSettings:
    """The friction a protocol stands for, with some settings changed.

    Raises:
        SpecError: A setting is unknown or cannot be.
    """
    start = FrictionSettings.literal() if protocol == "paper" else FrictionSettings()
    given = asdict(start) | {"rest_speed": sign_width} | dict(changed)
    try:
        return FrictionSettings.given(given)
    except SpecError as error:
        raise SpecError(f"friction_settings: {error.message}", hint=error.hint) from error


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
    """Trainings of which the one that validates best is kept; a single one if rates are given."""
    if kind == "none":  # without parameters there is nothing that a rate of theirs could be for
        rates = {name: rate for name, rate in training.group_rates.items() if name != FRICTION}
        return (training.model_copy(update={"group_rates": rates}),)
    if protocol == "paper" or FRICTION in training.group_rates:
        return (training,)
    return tuple(_with_rate(training, rate) for rate in FRICTION_RATES.get(kind, (1.0,)))


def _with_rate(training: TrainingSettings, rate: float) -> TrainingSettings:
    if rate == 1.0:
        return training
    rates = {**training.group_rates, FRICTION: rate}
    return training.model_copy(update={"group_rates": rates})


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
