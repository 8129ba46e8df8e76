"""Training of residual networks; each trajectory is evaluated by a network not trained on it.

With folds, there is one network per fold. The network of a fold is trained on the other folds, uses
its own fold for early stopping, and predicts the corrections of its own fold. The final correction
is the mean of the outputs of all networks. Without folds, there is a single network with separate
validation trajectories.

`CausalTcn` is the network (eq. 26–27 of the PINN paper). In `CausalTcn`, a first linear layer maps
the inputs to the channels. Every further layer computes y = x + σ(w *_d x + b), truncated at the
old end (Bai, Kolter & Koltun 2018), and uses no future samples. The groups of `CausalTcn` are
parallel networks that share no weights. The output weights start at zero, so an untrained network
does not change the prediction of the physics. This module imports torch, so other modules must
import this module only inside functions; `hil.networks.residual_tcn` predicts without torch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray
from hil.data import Dataset, training_and_validation
from hil.networks.residual_data import (
    GROUP,
    TRAINING,
    Motions,
    NetworkInputs,
    ResidualSettings,
    Segments,
    in_motion,
    motion_frequency,
    sizes,
    slow_and_fast,
)
from hil.networks.residual_selection import Learnt, Physics
from hil.networks.residual_tcn import Single, TcnWeights, TrainedTcn
from hil.networks.training import Curves, LossKind, TrainingSettings, Watch, joint_stages, unwatched
from hil.networks.training_loop import Loss, torch_device, torch_dtype, train


@dataclass(frozen=True, slots=True)
class Course:
    """Settings for training residual networks.

    Attributes:
        network: Inputs and size of the networks.
        training: Training settings, such as steps, batches and stopping criteria.
        validation_share: Share of the trajectories used for early stopping if there are no folds.
        seed: Seed of start weights, mini-batches and the choice of held-out trajectories.
        watch: Function that is called with every epoch.
        checkpoints: Folder for the checkpoints.
    """

    network: ResidualSettings
    training: TrainingSettings
    validation_share: float
    seed: int
    watch: Watch | None
    checkpoints: Path | None


def learn(data: Dataset, physics: Physics, course: Course) -> Learnt:
    """Train networks on filtered data at the full recorded rate.

    Args:
        data: Prepared dataset with all its rows.
        physics: Predictions of the physics, which the networks correct.
        course: Settings of networks and training.

    Raises:
        FitError: The training diverged, or there are no training rows or no validation rows.
        DataError: The series have different sample rates, or a required torque input is missing.
        PluginError: The extra `learn` is missing.
    """
    motions = Motions.of(data, physics.predicted, course.network)
    residual = data["effort_f"] - physics.predicted
    usable = physics.valid & in_motion(data)
    correction = np.zeros_like(residual)
    judged, used = (np.zeros(len(data), dtype=bool) for _ in range(2))
    networks, curves = [], []
    for number, (fit, stop) in enumerate(_rounds(data, physics.fold, course)):
        _require_rows(fit & usable, stop & usable)
        network, curve = _train(motions, residual, fit & usable, stop & usable, course, number)
        held = stop & usable
        correction[held] = network.predict(motions)[held]
        judged |= held
        used |= held | (fit & usable)
        networks.append(network)
        curves.append(curve)
    return Learnt(tuple(networks), correction, judged, used, tuple(curves))


def _rounds(data: Dataset, fold: IntArray, course: Course) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Yield a mask of the training rows and a mask of the validation rows for each network."""
    numbers = np.unique(fold[fold >= 0])
    if len(numbers) < 2:
        yield training_and_validation(data, course.validation_share, course.seed)
        return
    for number in numbers:
        yield (fold >= 0) & (fold != number), fold == number


def _require_rows(fit: BoolArray, stop: BoolArray) -> None:
    for rows, what in ((fit, "to train on"), (stop, "for early stopping")):
        if not np.any(rows):
            raise FitError(
                f"the residual network has no rows {what} for which the physics is valid",
                hint="use at least two trajectories, or one that is longer",
            )


def _train(
    motions: Motions,
    residual: FloatArray,
    fit: BoolArray,
    stop: BoolArray,
    course: Course,
    number: int,
) -> tuple[TrainedTcn, Curves]:
    settings = course.training.model_copy(update={"seed": course.seed + number})
    problem = ResidualProblem(
        motions,
        residual,
        fit,
        stop,
        course.network,
        loss=settings.loss,
        seed=settings.seed,
        device=torch_device(settings.device),
        dtype=torch_dtype(settings.precision),
    )
    kept = None if course.checkpoints is None else course.checkpoints / f"network-{number + 1}"
    curves = train(
        problem, joint_stages(settings, "residual"), settings, course.watch or unwatched, kept
    )
    return problem.trained(), curves


TOGETHER = 64
"""Number of crops that are validated at once, which limits memory."""


class ResidualProblem:
    """Training problem for the residual of a physical model at the full recorded rate.

    A sample is a crop: `settings.crop` instants to predict, each with the window of rows before it.
    Only instants of training rows contribute to the loss. The inputs of a crop can come from any
    row, because a causal network uses only earlier samples.

    Args:
        motions: All series with all their rows.
        residual: (N, n) measured minus predicted effort.
        learn: (N,) mask of the training rows. Scales, the cut-off frequency and the slow and fast
            parts are computed from the training rows only. However, a filter that was applied to
            the residual beforehand can have mixed other rows into the training rows.
        validate: (N,) mask of the validation rows.
        settings: Settings of the network.
        loss: Loss of the prediction errors, relative to the size of the residual or of its slow and
            fast part.
        seed: Seed of the start weights.
        device: Device of the data and the network.
        dtype: Number type of the data and the network.

    Attributes:
        module: Network (`CausalTcn`) whose groups are the branches and joints.
        samples: Number of crops.
        f_cut_hz: Cut-off frequency between slow and fast part [Hz]; 0 without a split.

    Raises:
        DataError: There are no training rows or no validation rows, values are not finite, or a
            required torque input is missing.
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
        """Return a single parameter group with all weights."""
        return {GROUP: tuple(self.module.parameters())}

    def loss(self, chosen: Tensor) -> Tensor:
        """Return the mean loss over the counted rows, branches and joints of the crops (B,)."""
        numbers = chosen.cpu().numpy()
        rows = torch.as_tensor(self._learn.rows[numbers], device=self._x.device)
        counted = torch.as_tensor(self._learn.counted[numbers], device=self._x.device)
        each = self._loss.elements(self._outputs(self._learn, numbers), self._target[rows])
        return each[counted].mean()

    def validate(self) -> float:
        """Return the validation error relative to the size of the training residual.

        The validation error is the mean over all joints. A network whose correction is always zero
        has a validation error of about 1.
        """
        return float(np.mean(self.validation_errors() / self._size))

    def validation_errors(self) -> FloatArray:
        """Return the root mean square error (n,) over the validation rows, in units of effort."""
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
        """Return the network with its current weights."""
        return TrainedTcn(
            self.inputs, self._network.weights(), self.scale, self.motions.rate_hz, self.f_cut_hz
        )

    def _outputs(self, segments: Segments, numbers: IntArray) -> Tensor:
        """Return the network outputs (B, crop, branches, n) for the crops with the numbers (B,)."""
        at = torch.as_tensor(segments.inputs_of(numbers, self.settings), device=self._x.device)
        x = self._x[..., at].permute(2, 0, 1, 3)  # (B, G, F, L)
        y = self._network(x.repeat(1, self.settings.branches, 1, 1), segments.every)
        # (B, branches·G, O, crop), and G·O = n.
        return y.flatten(1, 2).unflatten(1, self.scale.shape).permute(0, 3, 1, 2)


def _require_usable(
    motions: Motions, residual: FloatArray, learn: BoolArray, validate: BoolArray
) -> None:
    if not (np.any(learn) and np.any(validate)):
        raise DataError(
            "a residual network needs training rows and rows for early stopping",
            hint="record more, or lower validation_share",
        )
    columns = {"q": motions.q, "qd": motions.qd, "qdd": motions.qdd, "base": motions.base}
    columns |= {"residual": residual}
    columns |= {} if motions.effort is None else {"effort": motions.effort}
    for name, values in columns.items():
        if values.shape != motions.q.shape or not np.all(np.isfinite(values)):
            raise DataError(
                f"{name} of the residual network is not finite or not {motions.q.shape}",
                hint="import the file again with --drop-bad-rows, or leave the recording out",
            )


def _cut_off(motions: Motions, learn: BoolArray, settings: ResidualSettings) -> float:
    if not settings.parted:
        return 0.0
    return settings.f_cut_hz if settings.f_cut_hz != "auto" else motion_frequency(motions, learn)


class CausalTcn(nn.Module):
    """Set of G parallel causal networks with separate inputs and outputs.

    Args:
        inputs: Number of inputs F of each group.
        outputs: Number of outputs O of each group.
        settings: Settings of the network: channels, kernel, dilations and activation.
        groups: Number of groups G.
        seed: Seed of the start weights.
    """

    def __init__(
        self, inputs: int, outputs: int, settings: ResidualSettings, groups: int = 1, seed: int = 0
    ) -> None:
        super().__init__()
        self.settings = settings
        self.groups = groups
        width, kernel = settings.width, settings.kernel
        draw = torch.Generator().manual_seed(seed)

        def drawn(*shape: int, fan_in: int) -> nn.Parameter:
            bound = 1.0 / math.sqrt(fan_in)
            return nn.Parameter((2 * torch.rand(shape, generator=draw) - 1) * bound)

        self.enter = drawn(groups, width, inputs, fan_in=inputs)
        self.enter_bias = nn.Parameter(torch.zeros(groups, width))
        self.taps = nn.ParameterList(
            drawn(groups, width, width, kernel, fan_in=width * kernel) for _ in settings.dilations
        )
        self.biases = nn.ParameterList(
            drawn(groups, width, fan_in=width * kernel) for _ in settings.dilations
        )
        self.leave = nn.Parameter(torch.zeros(groups, outputs, width))
        self.leave_bias = nn.Parameter(torch.zeros(groups, outputs))

    def forward(self, x: Tensor, every: int = 1) -> Tensor:
        """Return outputs (B, G, O, L) from inputs (B, G, F, (L - 1)·every + window).

        Args:
            x: Inputs of the networks at every sample.
            every: Number of samples between two outputs, which divides all dilations but the first.
                All layers after the first are evaluated only at the output instants, which divides
                their cost by `every`.
        """
        batch, length = x.shape[0], x.shape[-1]
        h = self._mixed(x.reshape(batch, -1, length), self.enter, self.enter_bias)
        for number, dilation in enumerate(self.settings.dilations):
            apart = (every, dilation) if number == 0 else (1, dilation // every)
            h = self._layer(h, number, *apart)
        out = self._mixed(h, self.leave, self.leave_bias)
        return out.reshape(batch, self.groups, -1, out.shape[-1])

    def _layer(self, h: Tensor, number: int, stride: int, dilation: int) -> Tensor:
        taps, bias = self.taps[number], self.biases[number]
        y = functional.conv1d(
            h, taps.flatten(0, 1), bias.flatten(), stride, 0, dilation, self.groups
        )
        y = torch.tanh(y) if self.settings.activation == "tanh" else torch.relu(y)
        newest = (self.settings.kernel - 1) * dilation
        return y + h[..., newest::stride][..., : y.shape[-1]]

    def _mixed(self, h: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return a linear combination of the channels of each group, for each sample."""
        return functional.conv1d(
            h, weight.flatten(0, 1)[..., None], bias.flatten(), groups=self.groups
        )

    def weights(self) -> TcnWeights:
        """Return the current weights for prediction without torch."""
        return TcnWeights(
            enter=_array(self.enter),
            enter_bias=_array(self.enter_bias),
            taps=tuple(_array(taps) for taps in self.taps),
            biases=tuple(_array(bias) for bias in self.biases),
            leave=_array(self.leave),
            leave_bias=_array(self.leave_bias),
            dilations=self.settings.dilations,
            activation=self.settings.activation,
        )


def _array(values: Tensor) -> Single:
    return np.array(values.detach().float().cpu().numpy())
