"""Learning curves: what every epoch of a training came to. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hil.networks.training_loop.problem import Told

BARS = "▁▂▃▄▅▆▇█"


@dataclass(slots=True)
class Curves:
    """Loss and validation error per epoch.

    Attributes:
        untrained: Validation error before the first step.
        stage: Name of every epoch's stage.
        loss: Mean training loss of every epoch.
        validation: Validation error after it.
        learning_rate: At its end.
        best: Least validation error, the untrained network's included: that of the weights kept.
        best_epoch: Its number, from 1; 0 is the untrained network.
    """

    untrained: float
    stage: list[str] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    learning_rate: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """Least validation error, the untrained network's included."""
        return min([self.untrained, *self.validation])

    @property
    def best_epoch(self) -> int:
        """Number of the epoch it came after."""
        everything = [self.untrained, *self.validation]
        return everything.index(min(everything))

    def __len__(self) -> int:
        return len(self.loss)

    def last(self, epochs: int) -> list[float]:
        """Validation errors of so many epochs at the end."""
        return self.validation[len(self.validation) - epochs :]

    def add(self, told: Told) -> None:
        """One more epoch."""
        self.stage.append(told.stage)
        self.loss.append(told.loss)
        self.validation.append(told.validation)
        self.learning_rate.append(told.learning_rate)

    def to_dict(self) -> dict[str, Any]:
        """As JSON, for model files and checkpoints."""
        return {
            "untrained": self.untrained,
            "stages": [[name, count] for name, count in self.spans()],
            "loss": list(self.loss),
            "validation": list(self.validation),
            "learning_rate": list(self.learning_rate),
            "best": self.best,
            "best_epoch": self.best_epoch,
        }

    @classmethod
    def from_dict(cls, facts: Mapping[str, Any]) -> Curves:
        """Inverse of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or no number.
        """
        spans = [(str(name), int(count)) for name, count in facts["stages"]]
        loss, validation, rate = (
            [_finite(value) for value in facts[key]]
            for key in ("loss", "validation", "learning_rate")
        )
        # Counted before it is unrolled: a damaged count may be any number.
        counted = {sum(count for _, count in spans), len(loss), len(validation), len(rate)}
        if len(counted) > 1 or any(count < 1 for _, count in spans):
            raise ValueError(f"curves: stages and losses of {sorted(counted)} epochs")
        stage = [name for name, count in spans for _ in range(count)]
        return cls(_finite(facts["untrained"]), stage, loss, validation, rate)

    def spans(self) -> list[tuple[str, int]]:
        """Stages in their order, with the number of epochs each took."""
        found: list[tuple[str, int]] = []
        for name in self.stage:
            if found and found[-1][0] == name:
                found[-1] = (name, found[-1][1] + 1)
            else:
                found.append((name, 1))
        return found


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"curves: {value!r} is no error or rate")
    return number


def sparkline(values: Sequence[float], width: int = 24) -> str:
    """A curve in one line of text, on a logarithmic scale; the newest value is the last."""
    finite = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    if not finite:
        return ""
    shown = _thinned(finite, width)
    low, high = min(shown), max(shown)
    span = (high - low) or 1.0
    return "".join(BARS[round((value - low) / span * (len(BARS) - 1))] for value in shown)


def _thinned(values: Sequence[float], width: int) -> list[float]:
    if len(values) <= width:
        return list(values)
    last = len(values) - 1
    return [values[round(k * last / (width - 1))] for k in range(width)]
