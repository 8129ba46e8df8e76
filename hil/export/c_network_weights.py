"""Weights of residual networks in the order in which the C program reads them.

A cell is the network of one branch and fold, of one kept joint in layout `grouped` and of all in
`joint`. All cells read a set of inputs; the branches share it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.core import FloatArray
from hil.networks import Correction, TrainedTcn

BLOCK = 4
"""Channels and inputs are filled up to a multiple with zeros: loops go by so many at once."""


@dataclass(frozen=True, slots=True, eq=False)
class CellWeights:
    """S sets of F inputs, E cells of W channels, L layers of K taps, O outputs of each cell.

    F and W are multiples of `BLOCK`; what was added weighs nothing. Products over channels have
    the channels that come out last, so that neighbours are computed together.

    Attributes:
        means, rates, lowest, highest: (S, F) of the inputs: to subtract, to multiply by, the range.
        enter, enter_bias: (E, F·W) and (E, W).
        taps, biases: (L·E, K·W·W), the oldest tap first, and (L·E, W).
        leave, leave_bias: (E·O, W) and (E·O,).
        share: (E·O,) what an output counts for in the mean [effort unit].
        joints: (E·O,) whose effort it is.
    """

    means: FloatArray
    rates: FloatArray
    lowest: FloatArray
    highest: FloatArray
    enter: FloatArray
    enter_bias: FloatArray
    taps: FloatArray
    biases: FloatArray
    leave: FloatArray
    leave_bias: FloatArray
    share: FloatArray
    joints: NDArray[np.intp]


def cell_weights(correction: Correction) -> CellWeights:
    """Those of the kept joints; at least one is kept."""
    kept = np.flatnonzero(correction.kept)
    own = correction.settings.layout == "grouped"
    groups = kept if own else np.array([0])
    sets = [(network, group) for network in correction.networks for group in groups]
    cells = [
        _cell(network, int(group), branch, kept)
        for network, group in sets
        for branch in range(len(network.scale))
    ]
    layers = range(len(correction.settings.dilations))
    ranges = [_range(network, int(group)) for network, group in sets]
    means, rates, lowest, highest = (np.stack(some) for some in zip(*ranges, strict=True))
    outputs = [np.array([group]) if own else kept for _, group in sets]
    branches = correction.settings.branches
    return CellWeights(
        means=means,
        rates=rates,
        lowest=lowest,
        highest=highest,
        enter=np.stack([cell.enter for cell in cells]),
        enter_bias=np.stack([cell.enter_bias for cell in cells]),
        taps=np.stack([cell.taps[layer] for layer in layers for cell in cells]),
        biases=np.stack([cell.biases[layer] for layer in layers for cell in cells]),
        leave=np.concatenate([cell.leave for cell in cells]),
        leave_bias=np.concatenate([cell.leave_bias for cell in cells]),
        share=np.concatenate([cell.share for cell in cells]) / len(correction.networks),
        joints=np.concatenate([joints for joints in outputs for _ in range(branches)]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Cell:
    enter: FloatArray
    enter_bias: FloatArray
    taps: list[FloatArray]
    biases: list[FloatArray]
    leave: FloatArray
    leave_bias: FloatArray
    share: FloatArray


def _cell(network: TrainedTcn, group: int, branch: int, kept: NDArray[np.intp]) -> _Cell:
    weights, n = network.weights, network.n
    own = network.settings.layout == "grouped"
    at = branch * (n if own else 1) + group
    outputs = np.array([0]) if own else kept
    return _Cell(
        enter=filled(weights.enter[at].T, 0, 1).ravel(),
        enter_bias=filled(weights.enter_bias[at], 0),
        taps=[filled(taps[at].transpose(2, 1, 0), 1, 2).ravel() for taps in weights.taps],
        biases=[filled(bias[at], 0) for bias in weights.biases],
        leave=filled(weights.leave[at][outputs], 1),
        leave_bias=np.asarray(weights.leave_bias[at][outputs], dtype=np.float64),
        share=network.scale[branch][[group] if own else kept],
    )


def _range(network: TrainedTcn, group: int) -> Iterator[FloatArray]:
    """Means, rates, lowest and highest of a set of inputs, in `NetworkInputs`' order."""
    scales, settings = network.inputs.scales, network.settings
    zero = np.zeros(network.n)
    if settings.layout == "joint":
        mean = np.column_stack([scales.q_mean, zero, zero]).ravel()
        scale = np.column_stack([scales.q, scales.qd, scales.qdd]).ravel()
    else:
        # Signs are what they are.
        signs = len(settings.sign_widths)
        at = [group] if settings.base_input else []
        mean = np.r_[np.zeros(2 + signs), scales.base_mean[at]]
        base = scales.base[at]
        scale = np.r_[scales.qd[group], np.ones(signs), scales.qdd[group], base]
    for values in (mean, 1.0 / scale, scales.lowest[group], scales.highest[group]):
        yield filled(values, 0)


def filled(values: NDArray[np.float32] | FloatArray, *axes: int) -> FloatArray:
    """Zeros behind the values, up to a multiple of `BLOCK` along the axes."""
    behind = [(0, -size % BLOCK if axis in axes else 0) for axis, size in enumerate(values.shape)]
    return np.pad(np.asarray(values, dtype=np.float64), behind)
