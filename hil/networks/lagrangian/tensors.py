"""Rows of a dataset as tensors that stay in memory while a network is trained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hil.core import BoolArray, FloatArray
from hil.data import Dataset
from hil.networks.lagrangian.direction import DIRECTION

MOTION = ("q_f", "qd_f", "qdd_f", DIRECTION)
"""Columns that a network sees, in the order of its arguments."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """What a network sees of some rows, and the torque it should answer with.

    Attributes:
        motion: Position, velocity, acceleration and direction, each (N, n).
        torque: (N, n) [N·m], without that of declared loads.
    """

    motion: tuple[torch.Tensor, ...]
    torque: torch.Tensor

    def __len__(self) -> int:
        return len(self.torque)

    def take(self, chosen: torch.Tensor | slice) -> Rows:
        """Those with the numbers (B,), or of a range."""
        return Rows(tuple(column[chosen] for column in self.motion), self.torque[chosen])


def tensor_rows(
    data: Dataset,
    torque: FloatArray,
    wanted: BoolArray,
    *,
    dtype: torch.dtype,
    device: torch.device,
) -> Rows:
    """The wanted rows (N,) of a prepared dataset with the column `DIRECTION`."""

    def tensor(values: FloatArray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values[wanted]), dtype=dtype, device=device)

    return Rows(tuple(tensor(data[name]) for name in MOTION), tensor(torque))
