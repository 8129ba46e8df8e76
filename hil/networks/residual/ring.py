"""A residual network one sample at a time: every layer remembers what its taps reach back to.

A step costs what one instant of the series costs, not what its window does: the layers' outputs
of earlier samples are kept in ring buffers instead of being computed again.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hil.core import DataError, FloatArray
from hil.networks.residual.trained import TrainedTcn
from hil.networks.residual.weights import Single, TcnWeights, activated


class RingTcn:
    """Streams a `TrainedTcn`; equal to its pass over a whole series.

    Args:
        trained: The network.

    A stream begins with its first sample, as if that had lasted for ever before.
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
        """(n,) residual at this sample.

        Args:
            q: (n,) [rad].
            qd: (n,) [rad/s].
            qdd: (n,) [rad/s²].
            base: (n,) effort the physical model predicts.
            effort: (n,) measured at this sample, for networks that hear torque. A network with a
                history does not look at it before the latency has passed.

        Raises:
            DataError: The network hears torque, and none was given.
        """
        heard = self._heard(base, effort)
        one = (None if a is None else a[None] for a in (q, qd, qdd, base, heard))
        x = self._trained.inputs.rows(*one)[0]  # type: ignore[arg-type]  # only heard may be None
        branches = self._trained.scale.shape[0]
        out = self._advance(np.tile(x, (branches, 1)).astype(np.float32))
        return np.asarray(
            (out.reshape(self._trained.scale.shape) * self._trained.scale).sum(axis=0)
        )

    def reset(self) -> None:
        """Begin afresh with the next sample."""
        self._layers = None
        self._arriving.clear()

    def _heard(self, base: FloatArray, effort: FloatArray | None) -> FloatArray | None:
        settings = self._trained.settings
        if settings.inputs == "motion":
            return None
        if effort is None:
            raise DataError(
                f"the residual network has inputs: {settings.inputs}, so each step needs the "
                "measured effort",
                hint="a model for feed-forward is fitted with inputs: motion",
            )
        if settings.inputs == "measured":
            return effort
        self._arriving.append(effort - base if settings.layout == "grouped" else effort)
        if len(self._arriving) <= settings.lag(self._trained.rate_hz):
            return np.full_like(effort, np.nan)
        return self._arriving.popleft()

    def _advance(self, x: Single) -> Single:
        """(G, O) from inputs (G, F)."""
        weights = self._trained.weights
        h = (weights.enter @ x[..., None])[..., 0] + weights.enter_bias
        if self._layers is None:
            self._layers = _standing(weights, h)
        for layer in self._layers:
            h = layer.step(h)
        out: Single = (weights.leave @ h[..., None])[..., 0] + weights.leave_bias
        return out


class _Layer:
    """One layer and what came into it, as far back as its oldest tap."""

    def __init__(self, weights: TcnWeights, number: int, before: Single) -> None:
        taps = weights.taps[number]
        groups, width, _, kernel = taps.shape
        # (G, C, K·C): all taps of a channel as one row, so that a step is one product.
        self._taps = np.ascontiguousarray(taps.transpose(0, 1, 3, 2).reshape(groups, width, -1))
        self._bias = weights.biases[number]
        self._activation = weights.activation
        reach = (kernel - 1) * weights.dilations[number] + 1
        self._ring = np.broadcast_to(before, (reach, *before.shape)).copy()
        self._tap_rows = np.arange(kernel) * weights.dilations[number]
        self._oldest = 0

    def step(self, h: Single) -> Single:
        """(G, C) out of (G, C)."""
        reach = len(self._ring)
        self._ring[self._oldest] = h
        self._oldest = (self._oldest + 1) % reach
        seen = self._ring[(self._oldest + self._tap_rows) % reach]  # (K, G, C), oldest first
        row = seen.transpose(1, 0, 2).reshape(len(h), -1, 1)
        total = (self._taps @ row)[..., 0] + self._bias
        return activated(total, self._activation) + h


def _standing(weights: TcnWeights, h: Single) -> list[_Layer]:
    """Layers as after an endless time with the same input to the first of them (G, C)."""
    layers = []
    for number in range(len(weights.taps)):
        layer = _Layer(weights, number, h)
        layers.append(layer)
        h = layer.step(h)  # every tap holds h, and still does so afterwards
    return layers
