"""How to train, checked before anything is computed."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, get_args

from hil.core import SpecError
from hil.estimators import choice, number, require_known, whole
from hil.networks.lm.arrays import Precision
from hil.networks.lm.steps import Solver


@dataclass(frozen=True, slots=True)
class Damping:
    """How the damping, relative to the mean diagonal of JᵀJ, follows success and failure.

    Attributes:
        start: Before the first step.
        fall: It is divided by this after a step that lowers the cost.
        rise: It is multiplied by this after one that does not.
        least, most: Its limits.
        tries: Steps tried per epoch; when all fail, that network has converged.
    """

    start: float = 1e-2
    fall: float = 3.0
    rise: float = 3.0
    least: float = 1e-12
    most: float = 1e12
    tries: int = 12

    def __post_init__(self) -> None:
        for name in ("start", "least", "most"):
            number(f"damping.{name}", getattr(self, name), above=0.0)
        for name in ("fall", "rise"):
            number(f"damping.{name}", getattr(self, name), above=1.0)
        whole("damping.tries", self.tries, at_least=1)


@dataclass(frozen=True, slots=True)
class Settings:
    """How to train; `hil.networks.lm.train` says what each means."""

    epochs: int = 1000
    patience: int | None = None
    weight_decay: float = 0.0
    damping: Damping = field(default_factory=Damping)
    target_rmse: float | None = None
    precision: Precision = "float64"
    device: str = "cpu"
    solver: Solver = "auto"

    def __post_init__(self) -> None:
        whole("epochs", self.epochs, at_least=0)
        if self.patience is not None:
            whole("patience", self.patience, at_least=1)
        number("weight_decay", self.weight_decay, at_least=0.0)
        if self.target_rmse is not None:
            number("target_rmse", self.target_rmse, at_least=0.0)
        choice("precision", self.precision, get_args(Precision))
        choice("solver", self.solver, get_args(Solver))
        if not isinstance(self.device, str):
            raise SpecError(f"device is {self.device!r}, but must be cpu, cuda or cuda:1 …")

    @staticmethod
    def given(settings: dict[str, Any]) -> Settings:
        """From keyword arguments.

        Raises:
            SpecError: There is no such setting, or it cannot have that value.
        """
        require_known(settings, tuple(f.name for f in fields(Settings)), "train")
        return Settings(**settings)
