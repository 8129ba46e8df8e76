"""A small problem for the training loop: two groups of parameters, data that do not change."""

from __future__ import annotations

from collections.abc import Callable

import torch

from hil.networks.training import Told
from hil.networks.training_loop import Loss

LEARN = 160
ALL = 240


class TwoParts(torch.nn.Module):
    """A network of two groups, with dropout where random numbers of torch shall matter."""

    def __init__(self, dropout: float = 0.0) -> None:
        super().__init__()
        self.dynamics = torch.nn.Sequential(
            torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Dropout(dropout),
            torch.nn.Linear(16, 2),
        )  # fmt: skip
        self.friction = torch.nn.Parameter(torch.zeros(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        moved: torch.Tensor = self.dynamics(x) + self.friction * torch.sign(x[:, :2])
        return moved


class SmallProblem:
    """sin and a sign of two inputs; the third input is noise."""

    samples = LEARN

    def __init__(
        self, seed: int = 0, *, dropout: float = 0.0, scale: float = 1.0, device: str = "cpu"
    ) -> None:
        draw = torch.Generator().manual_seed(5)
        x = 2 * torch.rand(ALL, 3, generator=draw) - 1
        y = scale * (torch.sin(3 * x[:, :2]) + 0.5 * torch.sign(x[:, :2]))
        self.x, self.y = x.to(device), y.to(device)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.module = TwoParts(dropout).to(device)
        self.measure = Loss("mse", y[:LEARN].std(0))
        self.order: list[int] = []
        self.spoil: Callable[[torch.Tensor], torch.Tensor] = lambda loss: loss

    def groups(self) -> dict[str, list[torch.nn.Parameter]]:
        return {
            "dynamics": list(self.module.dynamics.parameters()),
            "friction": [self.module.friction],
        }

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        self.order += chosen.tolist()
        return self.spoil(self.measure(self.module(self.x[chosen]), self.y[chosen]))

    def validate(self) -> float:
        return float(self.measure(self.module(self.x[LEARN:]), self.y[LEARN:]).detach())


class Watched:
    """Remembers what it was told; raises after so many epochs."""

    def __init__(self, raise_after: int | None = None) -> None:
        self.told: list[Told] = []
        self._last = raise_after

    def __call__(self, told: Told) -> None:
        self.told.append(told)
        if len(self.told) == self._last:
            raise KeyboardInterrupt


def weights(problem: SmallProblem) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in problem.module.state_dict().items()}


def equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """To the last bit."""
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
