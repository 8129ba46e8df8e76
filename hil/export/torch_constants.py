"""Arrays as a PyTorch module's own constants."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from hil.core import FloatArray


def hold(module: nn.Module, dtype: torch.dtype = torch.float64, /, **constants: FloatArray) -> None:
    """Make each array an attribute that goes with the module: a buffer, no parameter."""
    for name, values in constants.items():
        # An archive keeps whole arrays; torch would take over a transposed one's order.
        whole = np.ascontiguousarray(values)
        module.register_buffer(name, torch.tensor(whole, dtype=dtype))
