"""Weights as arrays of a model file, and back into a network."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import nn

from hil.core import FloatArray
from hil.estimators import with_prefix, without_prefix
from hil.networks.lagrangian.choices import Design
from hil.networks.lagrangian.model import NetworkModel

PREFIX = "network."
"""Before the name of every weight in a model file."""

Weights = Mapping[str, np.ndarray[Any, Any]]


def weights_of(module: nn.Module) -> dict[str, np.ndarray[Any, Any]]:
    """Every weight and scale by name."""
    return {name: value.detach().cpu().numpy() for name, value in module.state_dict().items()}


def network_of(design: Design, torque_std: FloatArray, weights: Weights) -> NetworkModel:
    """The network with its weights, on the CPU and in their precision.

    Raises:
        ValueError: Weights are missing, too many, of another shape or not finite.
    """
    _require_room(design, weights)
    module = NetworkModel(design, torque_std)
    wanted = module.state_dict()
    if wanted.keys() != weights.keys():
        odd = sorted(wanted.keys() ^ weights.keys())
        raise ValueError(f"weights: {odd[0]} is missing or does not belong to the network")
    for name, value in weights.items():
        _require_alike(name, value, wanted[name].numpy())
    doubled = any(value.dtype == np.float64 for value in weights.values())
    module.to(torch.float64 if doubled else torch.float32)
    module.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    for name, scale in module.named_buffers():
        if not torch.all(torch.isfinite(scale)):
            raise ValueError(f"torque_std: {name} is not finite")
    module.eval()
    return module


def named(weights: Weights) -> dict[str, np.ndarray[Any, Any]]:
    """As they stand in a model file."""
    return with_prefix(PREFIX, weights)


def unnamed(arrays: Weights) -> dict[str, np.ndarray[Any, Any]]:
    """The weights among the arrays of a model file."""
    return without_prefix(PREFIX, arrays)


def _require_room(design: Design, weights: Weights) -> None:
    """Refuse a design far larger than its weights before it takes up memory."""
    layers = [design.network.hidden]
    if design.kind in ("dissipative", "unconstrained"):
        layers.append(design.friction.hidden)
    needed = sum(sum(units) + sum(a * b for a, b in pairwise(units)) for units in layers)
    stored = sum(value.size for value in weights.values())
    if needed > stored:
        raise ValueError(f"hidden: a network of at least {needed} weights, {stored} are stored")


def _require_alike(name: str, value: np.ndarray[Any, Any], wanted: np.ndarray[Any, Any]) -> None:
    if value.shape != wanted.shape:
        raise ValueError(f"weights: {name} is {value.shape}, the network needs {wanted.shape}")
    if value.dtype.kind != wanted.dtype.kind:
        raise ValueError(f"weights: {name} holds {value.dtype}, the network {wanted.dtype}")
    # Whole numbers are places in a matrix: they follow from the design.
    if wanted.dtype.kind == "i" and not np.array_equal(value, wanted):
        raise ValueError(f"weights: {name} is not that of the network")
    if not np.all(np.isfinite(value)):
        raise ValueError(f"weights: {name} holds values that are not finite")
