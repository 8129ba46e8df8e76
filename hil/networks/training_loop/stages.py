"""In which order the parts of a network are trained. Imports no torch."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from hil.core import SpecError, did_you_mean
from hil.networks.training_loop.settings import TrainingSettings

DYNAMICS, FRICTION = "dynamics", "friction"
"""Groups of parameters of a Lagrangian network with friction."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the training.

    Attributes:
        name: For people, and for the learning curves.
        trains: Groups of parameters that move; the others are frozen. None named: all move.
        epochs: At most.
        patience: Epochs without a better validation error until it ends.
        learning_rate_factor: Times the settings' learning rate.
    """

    name: str
    trains: tuple[str, ...]
    epochs: int
    patience: int
    learning_rate_factor: float = 1.0


def joint_stages(settings: TrainingSettings, name: str = "joint") -> tuple[Stage, ...]:
    """One stage in which everything is trained."""
    return (Stage(name, (), settings.epochs, settings.patience),)


def hybrid_stages(settings: TrainingSettings) -> tuple[Stage, ...]:
    """Algorithm 1 of the PINN paper: joint learning and dynamics alone in turns, then dynamics.

    Lines 4 to 10 are the joint stage of a loop, 11 to 17 its inner stage with frozen friction, 19
    to 25 the outer one. "Until the loss function converges" is the stages' patience.

    Args:
        settings: `epochs` is spread over all stages.
    """
    count, alone = settings.loops, (DYNAMICS,)
    unit = settings.epochs / (count * (1.0 + settings.inner_share) + settings.outer_share)
    stages = []
    for loop in range(count):
        factor = settings.loop_rate**loop
        stages += [
            _stage(f"loop {loop + 1}: joint", (), unit, factor, settings),
            _stage(
                f"loop {loop + 1}: dynamics", alone, settings.inner_share * unit, factor, settings
            ),
        ]
    last = settings.loop_rate**count
    outer = _stage("outer: dynamics", alone, settings.outer_share * unit, last, settings)
    return (*stages, outer)


def require_groups(who: str, named: Iterable[str], groups: Collection[str]) -> None:
    """Refuse groups of parameters that a network does not have.

    Args:
        who: Begins the message: what names them.
        named: The groups it names.
        groups: Those that there are.

    Raises:
        SpecError: One of them is not there.
    """
    for name in named:
        if name not in groups:
            raise SpecError(
                f"{who} {name!r}, but the network has the groups {', '.join(groups)}",
                hint=did_you_mean(name, tuple(groups)),
            )


def _stage(
    name: str, trains: tuple[str, ...], epochs: float, factor: float, settings: TrainingSettings
) -> Stage:
    return Stage(name, trains, max(1, round(epochs)), settings.patience, factor)
