"""A residual network with its recordings, as the training loop asks for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import BoolArray, DataError, FloatArray, IntArray
from hil.networks.residual.inputs import NetworkInputs
from hil.networks.residual.motions import Motions
from hil.networks.residual.segments import Segments, sizes
from hil.networks.residual.settings import GROUP, TRAINING, ResidualSettings
from hil.networks.residual.split import motion_frequency, slow_and_fast
from hil.networks.residual.tcn import CausalTcn
from hil.networks.residual.trained import TrainedTcn
from hil.networks.training import LossKind
from hil.networks.training_loop import Loss

TOGETHER = 64
"""Crops validated at once; bounds memory."""


class ResidualProblem:
    """What a physical model leaves, to be learned at the full recorded rate.

    A sample is a crop: `settings.crop` instants to predict with the windows before them. Those
    instants count that are to be learned from; inputs may come from any row, since a causal
    network sees only what was before.

    Args:
        motions: All series, no rows left out.
        residual: (N, n) measured minus predicted effort.
        learn: (N,) rows to learn from; scales, the cut-off between slow and fast, and the two
            parts are of these alone. What smoothed the residual before is not known here.
        validate: (N,) rows to stop by.
        settings: The network's.
        loss: Of errors over the size of the residual, or of its slow and fast part each.
        seed: Of the start weights.
        device: Where the data are kept and the network is trained.
        dtype: Of both.

    Attributes:
        module: The `CausalTcn`; branches and joints are groups of it.
        samples: Crops.
        f_cut_hz: Where slow and fast part; 0 without a split.

    Raises:
        DataError: There are no rows to learn from or to stop by, values are not finite, or the
            torque that shall be heard is not there.
    """

    def __init__(
        self,
        motions: Motions,
        residual: FloatArray,
        learn: BoolArray,
        validate: BoolArray,
        settings: ResidualSettings,
        *,
        loss: LossKind = TRAINING["loss"],
        seed: int = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        _require_usable(motions, residual, learn, validate)
        self.settings, self.motions = settings, motions
        self.inputs = NetworkInputs.scaled_to(motions, learn, settings)
        self.f_cut_hz = _cut_off(motions, learn, settings)
        parts = residual[None]
        if settings.parted:
            parts = slow_and_fast(residual, motions, self.f_cut_hz, learn)
        self.scale = sizes(parts, learn)
        self._size = sizes(residual[None], learn)[0]
        self._learn = Segments.of(motions, learn, settings)
        self._validate = Segments.of(motions, validate, settings)
        self.samples = len(self._learn)

        def tensor(values: FloatArray) -> Tensor:
            return torch.as_tensor(values, dtype=dtype, device=device).contiguous()

        x = self.inputs.of(motions)
        self._x = tensor(np.moveaxis(x, 0, -1)[..., self._learn.padded])  # (G, F, P)
        self._target = tensor((parts / self.scale[:, None]).transpose(1, 0, 2))  # (N, branches, n)
        self._loss = Loss(loss, np.ones(motions.n))
        groups, features = x.shape[1:]
        network = CausalTcn(
            features, motions.n // groups, settings, settings.branches * groups, seed
        )
        self._network = network.to(device=device, dtype=dtype)
        self.module: nn.Module = self._network

    def groups(self) -> Mapping[str, Sequence[nn.Parameter]]:
        """One group: all weights."""
        return {GROUP: tuple(self.module.parameters())}

    def loss(self, chosen: Tensor) -> Tensor:
        """Mean over the rows that count, branches and joints of the crops (B,)."""
        numbers = chosen.cpu().numpy()
        rows = torch.as_tensor(self._learn.rows[numbers], device=self._x.device)
        counted = torch.as_tensor(self._learn.counted[numbers], device=self._x.device)
        each = self._loss.elements(self._outputs(self._learn, numbers), self._target[rows])
        return each[counted].mean()

    def validate(self) -> float:
        """Error over the size of what is learned from, mean over joints.

        About 1 is what adding nothing gives.
        """
        return float(np.mean(self.validation_errors() / self._size))

    def validation_errors(self) -> FloatArray:
        """(n,) root mean square error over the rows to stop by, in units of effort."""
        squares, count = np.zeros(self.motions.n), 0
        scale = torch.as_tensor(self.scale, dtype=self._x.dtype, device=self._x.device)
        for numbers in np.array_split(
            np.arange(len(self._validate)), -(-len(self._validate) // TOGETHER)
        ):
            counted = torch.as_tensor(self._validate.counted[numbers], device=self._x.device)
            rows = torch.as_tensor(self._validate.rows[numbers], device=self._x.device)
            with torch.no_grad():
                error = self._outputs(self._validate, numbers) - self._target[rows]
                left = (error * scale).sum(dim=-2)[counted]
            squares += left.double().square().sum(dim=0).cpu().numpy()
            count += len(left)
        return np.asarray(np.sqrt(squares / count))

    def trained(self) -> TrainedTcn:
        """The network as it is now."""
        return TrainedTcn(
            self.inputs, self._network.weights(), self.scale, self.motions.rate_hz, self.f_cut_hz
        )

    def _outputs(self, segments: Segments, numbers: IntArray) -> Tensor:
        """(B, crop, branches, n) of the crops with these numbers."""
        at = torch.as_tensor(segments.inputs_of(numbers, self.settings), device=self._x.device)
        x = self._x[..., at].permute(2, 0, 1, 3)  # (B, G, F, L)
        y = self._network(x.repeat(1, self.settings.branches, 1, 1), segments.every)
        # (B, branches·G, O, crop), and G·O = n.
        return y.flatten(1, 2).unflatten(1, self.scale.shape).permute(0, 3, 1, 2)


def _cut_off(motions: Motions, learn: BoolArray, settings: ResidualSettings) -> float:
    if not settings.parted:
        return 0.0
    return settings.f_cut_hz if settings.f_cut_hz != "auto" else motion_frequency(motions, learn)


def _require_usable(
    motions: Motions, residual: FloatArray, learn: BoolArray, validate: BoolArray
) -> None:
    if not (np.any(learn) and np.any(validate)):
        raise DataError(
            "a residual network needs rows to learn from and rows to stop by",
            hint="record more, or lower validation_share",
        )
    columns = {"q": motions.q, "qd": motions.qd, "qdd": motions.qdd, "base": motions.base}
    columns |= {"residual": residual}
    columns |= {} if motions.effort is None else {"effort": motions.effort}
    for name, values in columns.items():
        if values.shape != motions.q.shape or not np.all(np.isfinite(values)):
            raise DataError(
                f"{name} of the residual network is not finite or not {motions.q.shape}",
                hint="import the file again with --drop-bad-rows, or leave the series out",
            )
