"""Prediction with the residual network in numpy: a dilated causal convolutional network.

The network is defined by eq. 26–27 of the PINN paper. Models predict with the module `residual_tcn`
alone; PyTorch is only needed for training. `TcnWeights` evaluates a series, `TrainedTcn` adds
scaled inputs and outputs, and `RingTcn` computes the result of `TrainedTcn` one sample at a time.
The values before a series are assumed to equal its first sample; an arm that starts at standstill
is thus treated as static before the start.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.core import DataError, FloatArray
from hil.estimators import with_prefix, without_prefix
from hil.networks.residual_data import (
    RATE_TOLERANCE,
    Activation,
    InputScales,
    Motions,
    NetworkInputs,
    ResidualSettings,
)

SCALES, WEIGHTS = "scales.", "weights."
"""Prefixes of the array names of the network."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainedTcn:
    """Network that predicts the residual of a physical model, in the effort unit of that model.

    Attributes:
        inputs: Network inputs with their scales.
        weights: Weights of all groups and branches.
        scale: (branches, n) root mean square of each part (slow and fast) in the training rows.
        rate_hz: Sample rate of the training data [Hz]; the memory of the network counts samples.
        f_cut_hz: Cut-off frequency between slow and fast part [Hz]; 0 without a split.
    """

    inputs: NetworkInputs
    weights: TcnWeights
    scale: FloatArray
    rate_hz: float
    f_cut_hz: float

    @property
    def settings(self) -> ResidualSettings:
        """Settings with which the network was trained."""
        return self.inputs.settings

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.scale.shape[1])

    def predict(self, motions: Motions) -> FloatArray:
        """Return the residual (N, n) of every row; the memory is reset at the start of a series.

        Raises:
            DataError: A required torque input is missing, or the sample rate differs from
                `rate_hz`.
        """
        return np.asarray(self.parts(motions).sum(axis=0))

    def parts(self, motions: Motions) -> FloatArray:
        """Return the parts of the residual (branches, N, n): slow and fast part, or only their sum.

        Raises:
            DataError: A required torque input is missing, or the sample rate differs from
                `rate_hz`.
        """
        if abs(motions.rate_hz / self.rate_hz - 1.0) > RATE_TOLERANCE:
            raise DataError(
                f"the residual network was trained at {self.rate_hz:.4g} Hz, but the sample rate "
                f"is {motions.rate_hz:.4g} Hz",
                hint="record at the rate of the training, or fit again",
            )
        inputs = self.inputs.of(motions)
        out = np.zeros((len(self.scale), len(motions), self.n))
        for rows in motions.slices():
            branched = np.tile(inputs[rows], (1, len(self.scale), 1))
            out[:, rows] = self._scaled(self.weights.series(branched))
        return out

    def _scaled(self, outputs: FloatArray) -> FloatArray:
        """Return the scaled outputs (branches, N, n) from the raw outputs (N, G, O)."""
        parts = outputs.reshape(len(outputs), *self.scale.shape) * self.scale
        return np.asarray(parts.transpose(1, 0, 2))

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays for a model file, in which `settings.to_json()` is a separate entry."""
        scales = with_prefix(SCALES, self.inputs.scales.to_arrays())
        weights = with_prefix(WEIGHTS, self.weights.to_arrays())
        rates = {"rate_hz": np.array([self.rate_hz]), "f_cut_hz": np.array([self.f_cut_hz])}
        return {"scale": self.scale, **rates, **scales, **weights}

    @staticmethod
    def from_arrays(arrays: Mapping[str, FloatArray], settings: dict[str, Any]) -> TrainedTcn:
        """Return the network from the result of `to_arrays`.

        Raises:
            DataError: Arrays are missing or do not match each other.
            SpecError: The settings are invalid.
        """
        chosen = ResidualSettings.given(settings)
        missing = [name for name in ("scale", "rate_hz", "f_cut_hz") if name not in arrays]
        if missing:
            raise DataError(f"the residual network has no {', '.join(missing)}")
        scale = np.asarray(arrays["scale"], dtype=np.float64)
        if scale.ndim != 2 or len(scale) != chosen.branches:
            raise DataError(f"the residual network's scale has the shape {scale.shape}")
        scales = InputScales.from_arrays(without_prefix(SCALES, arrays), chosen, scale.shape[1])
        weights = TcnWeights.from_arrays(without_prefix(WEIGHTS, arrays), chosen)
        weights.require(scale.shape, scales.lowest.shape)
        rate, f_cut = float(arrays["rate_hz"][0]), float(arrays["f_cut_hz"][0])
        if not (np.isfinite(rate) and rate > 0.0):
            raise DataError(f"the residual network's rate_hz is {rate:g}, but must be above 0")
        return TrainedTcn(NetworkInputs(chosen, scales), weights, scale, rate, f_cut)


Single = NDArray[np.float32]

CHUNK = 16_384
"""Number of rows that are evaluated at once, which limits memory for long recordings."""


@dataclass(frozen=True, slots=True, eq=False)
class TcnWeights:
    """Weights of G parallel networks, each with F inputs, C channels, K taps and O outputs.

    Attributes:
        enter, enter_bias: (G, C, F) and (G, C) weights and biases from inputs to channels.
        taps: (G, C, C, K) weights of each layer, with the oldest tap first.
        biases: (G, C) per layer.
        leave, leave_bias: (G, O, C) and (G, O) weights and biases from channels to outputs.
        dilations: Number of samples between the taps of each layer.
        activation: Activation function of every layer.
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
        """Return outputs (G, O, L) from inputs (G, F, L + window - 1), one output per window."""
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
        """Number of samples on which an output depends."""
        kernel = int(self.taps[0].shape[-1])
        return 1 + (kernel - 1) * sum(self.dilations)

    def series(self, inputs: FloatArray) -> FloatArray:
        """Return the outputs (N, G, O) for the inputs (N, G, F) of one series, N ≥ 1."""
        before = np.repeat(inputs[:1], self.window - 1, axis=0)
        x = np.concatenate([before, inputs]).astype(np.float32).transpose(1, 2, 0)
        out = np.empty((len(inputs), *self.leave_bias.shape))
        for start in range(0, len(inputs), CHUNK):
            stop = min(start + CHUNK, len(inputs))
            part = self.forward(np.ascontiguousarray(x[..., start : stop + self.window - 1]))
            out[start:stop] = part.transpose(2, 0, 1)
        return out

    def require(self, scale: tuple[int, ...], inputs: tuple[int, ...]) -> None:
        """Raise if the weights are for a different number of joints, branches or inputs.

        Args:
            scale: (branches, n) shape of the outputs.
            inputs: (G, F) shape of the inputs of each branch.

        Raises:
            DataError: The numbers of joints, branches or inputs do not match.
        """
        branches, n = scale
        groups, features = inputs
        wanted = (branches * groups, self.enter.shape[1], features)
        if self.enter.shape != wanted or self.leave_bias.size != branches * n:
            raise DataError(
                f"the residual network's weights are those of {self.enter.shape[0]} groups of "
                f"{self.enter.shape[2]} inputs and {self.leave_bias.size} outputs, not for "
                f"{wanted[0]} of {features} and {branches * n}"
            )

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return the weights by name for a model file."""
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
        """Return the weights from the result of `to_arrays`.

        Raises:
            DataError: An array is missing, or has a shape that does not match the settings.
        """
        layers = range(len(settings.dilations))
        names = ["enter", "enter_bias", "leave", "leave_bias"]
        names += [f"{kind}_{i}" for i in layers for kind in ("taps", "bias")]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise DataError(f"the residual network has no {', '.join(missing)}")
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
    """Apply the activation function: the hyperbolic tangent or max(x, 0)."""
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


class RingTcn:
    """Stream of a `TrainedTcn`, whose results equal those of `TrainedTcn` for a whole series.

    The values before a stream are assumed to equal its first sample.

    Args:
        trained: Trained network.
    """

    def __init__(self, trained: TrainedTcn) -> None:
        self._trained = trained
        self._layers: list[_Layer] | None = None
        self._arriving: deque[FloatArray] = deque()

    def step(
        self,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        base: FloatArray,
        effort: FloatArray | None = None,
    ) -> FloatArray:
        """Return the residual (n,) at the current sample.

        Args:
            q: (n,) position [rad].
            qd: (n,) velocity [rad/s].
            qdd: (n,) acceleration [rad/s²].
            base: (n,) effort predicted by the physical model.
            effort: (n,) effort measured at the current sample, for networks with torque inputs. A
                network with a torque history uses the passed effort only after the latency.

        Raises:
            DataError: The network has torque inputs, but no effort was passed.
        """
        heard = self._heard(base, effort)
        one = (None if a is None else a[None] for a in (q, qd, qdd, base, heard))
        x = self._trained.inputs.rows(*one)[0]  # type: ignore[arg-type]  # only heard may be None
        branches = self._trained.scale.shape[0]
        out = self._advance(np.tile(x, (branches, 1)).astype(np.float32))
        return np.asarray(
            (out.reshape(self._trained.scale.shape) * self._trained.scale).sum(axis=0)
        )

    def _heard(self, base: FloatArray, effort: FloatArray | None) -> FloatArray | None:
        settings = self._trained.settings
        if settings.inputs == "motion":
            return None
        if effort is None:
            raise DataError(
                f"the residual network has inputs: {settings.inputs}, so each step needs the "
                "measured effort",
                hint="fit a model for feed-forward control with inputs: motion",
            )
        if settings.inputs == "measured":
            return effort
        self._arriving.append(effort - base if settings.layout == "grouped" else effort)
        if len(self._arriving) <= settings.lag(self._trained.rate_hz):
            return np.full_like(effort, np.nan)
        return self._arriving.popleft()

    def _advance(self, x: Single) -> Single:
        """Return the outputs (G, O) for the inputs (G, F) of the next sample."""
        weights = self._trained.weights
        h = (weights.enter @ x[..., None])[..., 0] + weights.enter_bias
        if self._layers is None:
            self._layers = _standing(weights, h)
        for layer in self._layers:
            h = layer.step(h)
        out: Single = (weights.leave @ h[..., None])[..., 0] + weights.leave_bias
        return out


class _Layer:
    """Layer with a ring buffer of its inputs, which is as long as the memory of the layer."""

    def __init__(self, weights: TcnWeights, number: int, before: Single) -> None:
        taps = weights.taps[number]
        groups, width, _, kernel = taps.shape
        # (G, C, K·C): all taps of a channel form one row, so that a step is one matrix product.
        self._taps = np.ascontiguousarray(taps.transpose(0, 1, 3, 2).reshape(groups, width, -1))
        self._bias = weights.biases[number]
        self._activation = weights.activation
        reach = (kernel - 1) * weights.dilations[number] + 1
        self._ring = np.broadcast_to(before, (reach, *before.shape)).copy()
        self._tap_rows = np.arange(kernel) * weights.dilations[number]
        self._oldest = 0

    def step(self, h: Single) -> Single:
        """Return the outputs (G, C) for the inputs (G, C) of the next sample."""
        reach = len(self._ring)
        self._ring[self._oldest] = h
        self._oldest = (self._oldest + 1) % reach
        seen = self._ring[(self._oldest + self._tap_rows) % reach]  # (K, G, C), oldest first
        row = seen.transpose(1, 0, 2).reshape(len(h), -1, 1)
        total = (self._taps @ row)[..., 0] + self._bias
        return activated(total, self._activation) + h


def _standing(weights: TcnWeights, h: Single) -> list[_Layer]:
    """Return layers in the state that infinitely many equal inputs (G, C) cause."""
    layers = []
    for number in range(len(weights.taps)):
        layer = _Layer(weights, number, h)
        layers.append(layer)
        h = layer.step(h)  # all taps contain h, before and after the step
    return layers


def require_finite_arrays(arrays: dict[str, FloatArray]) -> None:
    """Raise if an array contains values that are not finite, before it is used for predictions.

    Raises:
        ValueError: An array contains a value that is not finite.
    """
    for name, values in arrays.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{name}: contains values that are not finite")
