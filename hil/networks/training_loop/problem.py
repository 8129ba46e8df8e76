"""What the training loop asks of whatever it trains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import torch

    from hil.core import HilError


class Problem(Protocol):
    """A network with its data in memory.

    Attributes:
        module: The network; its state dict is what a checkpoint keeps and early stopping restores.
        samples: How many there are to draw mini-batches from (rows, or segments of a motion).
    """

    module: torch.nn.Module
    samples: int

    def groups(self) -> Mapping[str, Sequence[torch.nn.Parameter]]:
        """Parameters by the name under which a stage trains or freezes them."""

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        """Mean loss over the samples with these numbers (B,), to be differentiated."""

    def validate(self) -> float:
        """Error on data that are not trained on; lower is better."""


@dataclass(frozen=True, slots=True)
class Told:
    """One epoch, for whoever watches and for the learning curves.

    Attributes:
        stage: Name of the stage.
        epoch: Number within the whole training, from 1.
        epochs: At most how many there will be.
        loss: Mean training loss over the epoch.
        validation: `Problem.validate` after it.
        best: Least validation so far.
        learning_rate: Of the network's parameters.
    """

    stage: str
    epoch: int
    epochs: int
    loss: float
    validation: float
    best: float
    learning_rate: float


Watch = Callable[[Told], None]


@runtime_checkable
class KeptIfPossible(Protocol):
    """A watch for whom a training goes on when its checkpoints cannot be written any more."""

    def not_kept(self, error: HilError) -> None:
        """Why; from now on the training is not kept."""


@runtime_checkable
class HearsBeginning(Protocol):
    """A watch that wants to know of a training before its first epoch, which may take minutes."""

    def began(self, what: str) -> None:
        """What is trained, and on how much."""


def unwatched(told: Told) -> None:
    """Progress that nobody watches."""
