"""What training minimises, so that joints of 30 N·m and of 3 N·m count alike."""

from __future__ import annotations

from typing import get_args

import numpy as np
import torch
from torch.nn.functional import smooth_l1_loss

from hil.core import FloatArray
from hil.estimators import choice
from hil.networks.training_loop.settings import LossKind

KINDS: tuple[str, ...] = get_args(LossKind)

FLOOR = 0.1
"""Standard deviations of a joint's torque added to the denominator of `smape-floored`."""

BETA = 0.05
"""Error over standard deviation at which `huber` turns from square to straight."""


class Loss:
    """Mean over joints and samples of one of five measures of an error.

    `smape` is eq. (20) of the PINN paper, 2|e|/(|τ| + |τ̂|), which is 2, with a gradient of 0,
    wherever the two have opposite signs, and steep near τ = 0; 0/0 counts 0. `smape-floored` adds
    a tenth of the joint's standard deviation below. `huber`, `mae` and `mse` are of e over the
    standard deviation.

    Args:
        kind: One of `KINDS`.
        scale: (n,) standard deviation of every output over the rows that are learned from.

    Raises:
        SpecError: There is no such kind.
    """

    def __init__(self, kind: LossKind, scale: FloatArray | torch.Tensor) -> None:
        self.kind: str = choice("loss", kind, KINDS)
        self._scale = torch.as_tensor(np.asarray(scale), dtype=torch.float64)

    def __call__(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Scalar mean of (…, n) against (…, n)."""
        return self.elements(predicted, measured).mean()

    def elements(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """(…, n) the same before the mean, for whoever masks or weighs."""
        if self._scale.device != predicted.device or self._scale.dtype != predicted.dtype:
            self._scale = self._scale.to(predicted)
        if self.kind in ("smape", "smape-floored"):
            floor = self._scale * FLOOR if self.kind == "smape-floored" else None
            return _smape(predicted, measured, floor)
        error = (predicted - measured) / self._scale
        if self.kind == "huber":
            return smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=BETA)
        return error.abs() if self.kind == "mae" else error.square()


def _smape(
    predicted: torch.Tensor, measured: torch.Tensor, floor: torch.Tensor | None
) -> torch.Tensor:
    twice = 2.0 * (predicted - measured).abs()
    total = predicted.abs() + measured.abs()
    if floor is not None:
        return twice / (total + floor)
    # Where both are 0 the numerator is 0 already; a divisor of 1 keeps the gradient finite.
    return twice / torch.where(total > 0, total, torch.ones_like(total))
