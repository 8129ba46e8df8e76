"""A dilated causal convolutional network in plain numpy: its weights, and a pass over a series.

Models predict with this alone; PyTorch is needed for training. Before a series begins its first
sample is taken to have lasted for ever, so that an arm which starts from rest is at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.core import DataError, FloatArray
from hil.networks.residual.settings import Activation, ResidualSettings

Single = NDArray[np.float32]

CHUNK = 16_384
"""Rows that pass through at once; bounds memory on long recordings."""


@dataclass(frozen=True, slots=True, eq=False)
class TcnWeights:
    """G networks side by side, each with F inputs, C channels, K taps and O outputs.

    Attributes:
        enter, enter_bias: (G, C, F) and (G, C): the inputs as channels.
        taps: Per layer (G, C, C, K), the oldest tap first.
        biases: Per layer (G, C).
        leave, leave_bias: (G, O, C) and (G, O).
        dilations: Per layer, samples between taps.
        activation: Of every layer.
    """

    enter: Single
    enter_bias: Single
    taps: tuple[Single, ...]
    biases: tuple[Single, ...]
    leave: Single
    leave_bias: Single
    dilations: tuple[int, ...]
    activation: Activation

    def forward(self, x: Single) -> Single:
        """(G, O, L) from inputs (G, F, L + window - 1): an output where the window is full."""
        h = self.enter @ x + self.enter_bias[..., None]
        for taps, bias, dilation in zip(self.taps, self.biases, self.dilations, strict=True):
            h = self._layer(h, taps, bias, dilation)
        out: Single = self.leave @ h + self.leave_bias[..., None]
        return out

    def _layer(self, h: Single, taps: Single, bias: Single, dilation: int) -> Single:
        kernel = taps.shape[-1]
        length = h.shape[-1] - (kernel - 1) * dilation
        total = np.broadcast_to(bias[..., None], (*bias.shape, length)).copy()
        for k in range(kernel):
            total += taps[..., k] @ h[..., k * dilation : k * dilation + length]
        return activated(total, self.activation) + h[..., -length:]

    @property
    def window(self) -> int:
        """Samples an output depends on."""
        kernel = int(self.taps[0].shape[-1])
        return 1 + (kernel - 1) * sum(self.dilations)

    def series(self, inputs: FloatArray) -> FloatArray:
        """(N, G, O) of one series of inputs (N, G, F), N ≥ 1."""
        before = np.repeat(inputs[:1], self.window - 1, axis=0)
        x = np.concatenate([before, inputs]).astype(np.float32).transpose(1, 2, 0)
        out = np.empty((len(inputs), *self.leave_bias.shape))
        for start in range(0, len(inputs), CHUNK):
            stop = min(start + CHUNK, len(inputs))
            part = self.forward(np.ascontiguousarray(x[..., start : stop + self.window - 1]))
            out[start:stop] = part.transpose(2, 0, 1)
        return out

    def require(self, scale: tuple[int, ...], inputs: tuple[int, ...]) -> None:
        """Refuse weights of another number of joints, branches or inputs.

        Args:
            scale: (branches, n) of what comes out.
            inputs: (G, F) of what goes into each branch.

        Raises:
            DataError: They do not fit.
        """
        branches, n = scale
        groups, features = inputs
        wanted = (branches * groups, self.enter.shape[1], features)
        if self.enter.shape != wanted or self.leave_bias.size != branches * n:
            raise DataError(
                f"the residual network's weights are for {self.enter.shape[0]} groups of "
                f"{self.enter.shape[2]} inputs and {self.leave_bias.size} outputs, "
                f"not for {wanted[0]} of {features} and {branches * n}"
            )

    def to_arrays(self) -> dict[str, FloatArray]:
        """For a model file."""
        named = {
            "enter": self.enter,
            "enter_bias": self.enter_bias,
            "leave": self.leave,
            "leave_bias": self.leave_bias,
        }
        for i, (taps, bias) in enumerate(zip(self.taps, self.biases, strict=True)):
            named |= {f"taps_{i}": taps, f"bias_{i}": bias}
        return {name: values.astype(np.float64) for name, values in named.items()}

    @staticmethod
    def from_arrays(arrays: Mapping[str, Any], settings: ResidualSettings) -> TcnWeights:
        """Inverse of `to_arrays`.

        Raises:
            DataError: An array is missing, or has not the shape the settings ask for.
        """
        layers = range(len(settings.dilations))
        names = ["enter", "enter_bias", "leave", "leave_bias"]
        names += [f"{kind}_{i}" for i in layers for kind in ("taps", "bias")]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise DataError(f"the residual network lacks {', '.join(missing)}")
        found = {name: np.asarray(arrays[name], dtype=np.float32) for name in names}
        _require_shapes(found, settings)
        return TcnWeights(
            enter=found["enter"],
            enter_bias=found["enter_bias"],
            taps=tuple(found[f"taps_{i}"] for i in layers),
            biases=tuple(found[f"bias_{i}"] for i in layers),
            leave=found["leave"],
            leave_bias=found["leave_bias"],
            dilations=settings.dilations,
            activation=settings.activation,
        )


def activated(values: Single, kind: Activation) -> Single:
    """The hyperbolic tangent or the positive part."""
    out: Single = np.tanh(values) if kind == "tanh" else np.maximum(values, 0.0)
    return out


def _require_shapes(found: Mapping[str, Single], settings: ResidualSettings) -> None:
    groups, width = found["enter"].shape[0], settings.width
    outputs = found["leave_bias"].shape[-1]
    wanted: dict[str, tuple[int, ...]] = {
        "enter": (groups, width, found["enter"].shape[-1]),
        "enter_bias": (groups, width),
        "leave": (groups, outputs, width),
        "leave_bias": (groups, outputs),
    }
    for i in range(len(settings.dilations)):
        wanted[f"taps_{i}"] = (groups, width, width, settings.kernel)
        wanted[f"bias_{i}"] = (groups, width)
    for name, shape in wanted.items():
        if found[name].shape != shape:
            raise DataError(
                f"the residual network's {name} has the shape {found[name].shape}, not {shape}"
            )
