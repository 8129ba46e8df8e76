"""Adam with a rate per group of parameters and a schedule over the steps of a stage."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch

from hil.networks.training_loop.settings import TrainingSettings
from hil.networks.training_loop.stages import Stage, require_groups

Groups = Mapping[str, Sequence[torch.nn.Parameter]]


class Steps:
    """Takes the steps of one stage.

    Args:
        groups: All parameters by group; those the stage does not train are frozen.
        stage: Which groups move, and how fast.
        settings: Rates, schedule, clipping.
        per_epoch: Steps of an epoch.

    Raises:
        SpecError: The stage or a rate names a group that the network does not have.
    """

    def __init__(
        self, groups: Groups, stage: Stage, settings: TrainingSettings, per_epoch: int
    ) -> None:
        require_groups(f"stage {stage.name!r} trains", stage.trains, groups)
        require_groups("group_rates has", settings.group_rates, groups)
        trained = {name: groups[name] for name in stage.trains or groups}
        for name, parameters in groups.items():
            for parameter in parameters:
                parameter.requires_grad_(name in trained)
        self._settings = settings
        self._total = max(1, stage.epochs * per_epoch)
        self._rate = settings.learning_rate * stage.learning_rate_factor
        self._parameters = [one for parameters in trained.values() for one in parameters]
        # Fused: one call for all parameters. Networks of this size spend their time in Python.
        self.adam = torch.optim.AdamW(_parts(trained, settings), lr=self._rate, fused=True)

    def take(self, loss: torch.Tensor, number: int) -> None:
        """Step `number` of the stage, from 0, down the gradient of a loss."""
        self.adam.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        if self._settings.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self._parameters, self._settings.clip_norm)
        rate = self.rate(number)
        for part in self.adam.param_groups:
            part["lr"] = rate * part["rate"]
        self.adam.step()

    def rate(self, number: int) -> float:
        """Learning rate at a step of the stage."""
        done = min(1.0, number / self._total)
        warm = self._settings.warm_up_steps
        rate = self._rate * (min(1.0, (number + 1) / warm) if warm else 1.0)
        if self._settings.schedule == "constant":
            return rate
        least = self._settings.final_rate
        return rate * (least + (1.0 - least) * 0.5 * (1.0 + math.cos(math.pi * done)))

    def state(self) -> dict[str, torch.Tensor]:
        """Adam's moments as `<number of the parameter>/<name>`."""
        state: dict[int, dict[str, torch.Tensor]] = self.adam.state_dict()["state"]
        return {f"{k}/{name}": value for k, one in state.items() for name, value in one.items()}

    def restore(self, state: Mapping[str, torch.Tensor]) -> None:
        """Inverse of `state`.

        Raises:
            ValueError: The moments are not those of these parameters.
        """
        found: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in state.items():
            number, _, name = key.partition("/")
            found.setdefault(int(number), {})[name] = value
        if found:
            _require_moments(found, [p for g in self.adam.param_groups for p in g["params"]])
        parts = self.adam.state_dict()["param_groups"]
        self.adam.load_state_dict({"state": found, "param_groups": parts})


def _require_moments(
    found: Mapping[int, Mapping[str, torch.Tensor]], parameters: Sequence[torch.nn.Parameter]
) -> None:
    if not found.keys() <= set(range(len(parameters))):
        raise ValueError(f"moments of {len(found)} parameters where there are {len(parameters)}")
    for number, moments in found.items():
        own = tuple(parameters[number].shape)
        shapes = {name: tuple(value.shape) for name, value in moments.items()}
        wanted = {"step": (), "exp_avg": own, "exp_avg_sq": own}
        if shapes != wanted:
            raise ValueError(f"moments of parameter {number}: {shapes}, not {wanted}")


def everything(groups: Groups) -> Iterator[torch.nn.Parameter]:
    """Parameters of all groups."""
    return (parameter for parameters in groups.values() for parameter in parameters)


def _parts(groups: Groups, settings: TrainingSettings) -> list[dict[str, Any]]:
    """Parameter groups of Adam: matrices decay, coefficients and biases do not."""
    parts = []
    for name, parameters in groups.items():
        rate = settings.group_rates.get(name, 1.0)
        for decay, chosen in _by_decay(parameters, settings.weight_decay):
            if chosen:
                parts.append({"params": chosen, "rate": rate, "weight_decay": decay})
    return parts


def _by_decay(
    parameters: Iterable[torch.nn.Parameter], decay: float
) -> tuple[tuple[float, list[torch.nn.Parameter]], ...]:
    listed = list(parameters)
    matrices = [one for one in listed if one.ndim > 1]
    others = [one for one in listed if one.ndim <= 1]
    return (decay, matrices), (0.0, others)
