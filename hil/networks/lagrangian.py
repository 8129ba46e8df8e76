"""Lagrangian network: torque from a learned M(q) and V(q) by the Euler–Lagrange equation (eq. 8).

Equation numbers in this module refer to the PINN paper. With T = ½ q̇ᵀM q̇, M = LLᵀ, u = Lᵀq̇ and a
dot for the rate of change along the motion, the torque is:

    τ = d/dt(M q̇) − ∂(T − V)/∂q,   d/dt(M q̇) = L̇u + L(L̇ᵀq̇ + Lᵀq̈),   ∂T/∂L = q̇uᵀ.

The code computes all derivatives by q explicitly, without autograd. A forward pass through the
layers (`Trunk.along`) returns the raw outputs and their rates of change along the motion, and hence
L̇. A backward pass through the layers (`Trunk.pull_back`) returns the gradient of a scalar by q.
The forward pass and the backward pass consist of matrix products and elementwise functions, so
autograd can differentiate them by the weights and exporters can write them as code. DeLaN (Lutter
2019; eq. 11–14) instead multiplies Jacobians layer by layer, with n tangents at once, and computes
∂M/∂q from the product.

The module contains, in this order: `LagrangianNetwork` with its layers (`Trunk`) and the Cholesky
factor of M (`Factor`); `NetworkModel`, which adds friction (eq. 19); the construction of a network
from stored weights; the prediction with a trained network; the training. This module imports torch,
so other modules must import this module only inside functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.core import BoolArray, FitError, FloatArray, SpecError
from hil.data import MOTION, Dataset
from hil.estimators import DahlMemory, one_sample
from hil.networks.lagrangian_data import DIRECTION, Task, smooth_sign
from hil.networks.lagrangian_friction import friction_network
from hil.networks.lagrangian_settings import Design, NetworkSettings
from hil.networks.training import FRICTION, Curves, Stage, TrainingSettings, Watch, unwatched
from hil.networks.training_loop import Loss, reproducible, torch_device, torch_dtype, train


class LagrangianNetwork(nn.Module):
    """Network with two heads, which together yield M(q), C(q, q̇)q̇ and g(q).

    The state dict contains only the weights; the torque scales must be passed again on
    construction.

    Args:
        n: Number of joints.
        settings: Structure and start weights of the network.
        torque_scale: (n,) typical torque of each joint [N·m], such as its standard deviation; None
            means 1 N·m.
        seed: Seed of the start weights; the construction does not change the global random
            generator of torch.

    Raises:
        SpecError: The torque scales are not n numbers above zero.
    """

    gravity_unit: Tensor

    def __init__(
        self,
        n: int,
        settings: NetworkSettings | None = None,
        torque_scale: Sequence[float] | FloatArray | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        chosen = NetworkSettings() if settings is None else settings
        unit = _unit(n, torque_scale, scaled=chosen.scaled)
        self._potential = chosen.gravity == "potential"
        self.factor = Factor(n, chosen, torch.sqrt(unit))
        heads = self.factor.entries + (1 if self._potential else n)
        self.trunk = Trunk(n, heads, chosen, seed)
        nn.init.constant_(self.trunk.last.bias[:n], chosen.diagonal_bias)
        gravity_unit = unit.max().reshape(1) if self._potential else unit
        self.register_buffer("gravity_unit", gravity_unit, persistent=False)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return torque (B, n) [N·m] at q [rad], q̇ [rad/s] and q̈ [rad/s²], each (B, n)."""
        at = self._along(q, qd)
        turned = times(at.factor.mT, qdd) + times(at.rate.mT, qd)
        pushed = times(at.rate, at.turned) + self.factor.momentum(at.factor, turned, qdd)
        kinetic = self._by_kinetic(at, qd)
        if not self._potential:
            return pushed - self.trunk.pull_back(kinetic, at.tape) + self._head(at)
        both = torch.cat([kinetic, self._by_potential(at)], dim=-1)
        return pushed - self.trunk.pull_back(both, at.tape)

    def parts(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Parts:
        """Return the terms of the torque separately, for the same arguments as `forward`."""
        at = self._along(q, qd)
        inertia = self.factor.momentum(at.factor, times(at.factor.mT, qdd), qdd)
        stirred = times(at.rate, at.turned) + times(at.factor, times(at.rate.mT, qd))
        kinetic = self._by_kinetic(at, qd)
        coriolis = stirred - self.trunk.pull_back(kinetic, at.tape)
        gravity = self._head(at) if not self._potential else self._uphill(at, kinetic)
        return Parts(self.factor.mass(at.factor), inertia, coriolis, gravity)

    def mass(self, q: Tensor) -> Tensor:
        """Return M(q) (B, n, n) [kg·m²], symmetric and positive definite."""
        return self.factor.mass(self.factor(self.trunk(q)))

    def _along(self, q: Tensor, qd: Tensor) -> _Motion:
        raw, raw_rate, tape = self.trunk.along(q, qd)
        factor, rate, slope = self.factor.along(raw, raw_rate)
        return _Motion(raw, tape, factor, rate, slope, times(factor.mT, qd))

    def _by_kinetic(self, at: _Motion, qd: Tensor) -> Tensor:
        """Return the gradient of the kinetic energy T by the raw entries of L.

        The epsilon that is added to M does not depend on q and has no gradient.
        """
        return self.factor.pull_back(qd.unsqueeze(-1) * at.turned.unsqueeze(-2), at.slope)

    def _by_potential(self, at: _Motion) -> Tensor:
        """Return the gradient of −V by the raw output of the potential."""
        # torch.ones_like would need the shape at run time; small export targets do not support it.
        return 0.0 * at.raw[..., -1:] - self.gravity_unit

    def _uphill(self, at: _Motion, kinetic: Tensor) -> Tensor:
        alone = torch.cat([torch.zeros_like(kinetic), -self._by_potential(at)], dim=-1)
        return self.trunk.pull_back(alone, at.tape)

    def _head(self, at: _Motion) -> Tensor:
        return self.gravity_unit * at.raw[..., self.factor.entries :]


class Parts(NamedTuple):
    """Terms of the inverse dynamics; inertia, coriolis and gravity add up to the torque.

    Attributes:
        mass: M(q) (B, n, n) [kg·m²].
        inertia: M(q)·q̈ (B, n) [N·m].
        coriolis: C(q, q̇)·q̇ (B, n) [N·m].
        gravity: g(q) (B, n) [N·m].
    """

    mass: Tensor
    inertia: Tensor
    coriolis: Tensor
    gravity: Tensor


class _Motion(NamedTuple):
    """Intermediate results: raw outputs, tape, L, L̇, slopes of the diagonal of L, u = Lᵀq̇."""

    raw: Tensor
    tape: Tape
    factor: Tensor
    rate: Tensor
    slope: Tensor
    turned: Tensor


def _unit(n: int, torque_scale: Sequence[float] | FloatArray | None, *, scaled: bool) -> Tensor:
    """Return the typical torques (n,) [N·m] as a tensor of torch's default type."""
    given = np.ones(n) if torque_scale is None else np.asarray(torque_scale, dtype=np.float64)
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0.0)):
        raise SpecError(
            f"torque_scale is {given.tolist()!r}, but must be {n} numbers above zero",
            hint="a joint with constant torque has no scale: leave the joint out, or set "
            "torque_scale",
        )
    return torch.as_tensor(given if scaled else np.ones(n), dtype=torch.get_default_dtype())


class Tape(NamedTuple):
    """Results of the forward pass through the layers that the backward pass needs.

    Attributes:
        slopes: Slopes of the activations of each hidden layer, each (B, units).
        turns: cos q and sin q, each (B, n); empty if the network uses raw q.
    """

    slopes: tuple[Tensor, ...]
    turns: tuple[Tensor, ...]


LINEAR_ABOVE = 40.0
"""Argument above which softplus is replaced by the identity; the replacement is exact in float64.

torch's default limit of 20 is too low: the value of softplus and its slope would disagree by 2e-9.
"""


def softplus(total: Tensor) -> tuple[Tensor, Tensor]:
    """Return log(1 + eˣ) and its slope."""
    return functional.softplus(total, 1.0, LINEAR_ABOVE), torch.sigmoid(total)


def relu(total: Tensor) -> tuple[Tensor, Tensor]:
    """Return max(x, 0) and its slope, which is 0 at x = 0."""
    value = functional.relu(total)
    return value, torch.sign(value)


def _tanh(total: Tensor) -> tuple[Tensor, Tensor]:
    value = torch.tanh(total)
    return value, 1.0 - value * value


def _silu(total: Tensor) -> tuple[Tensor, Tensor]:
    gate = torch.sigmoid(total)
    value = total * gate
    return value, gate + value * (1.0 - gate)


ACTIVATIONS: dict[str, Callable[[Tensor], tuple[Tensor, Tensor]]] = {
    "softplus": softplus,
    "relu": relu,
    "tanh": _tanh,
    "silu": _silu,
}
"""Activation functions by name; each function returns the value and the slope."""


class Trunk(nn.Module):
    """Layers of the network, from q (B, n) to raw outputs (B, m).

    Args:
        n: Number of joints.
        outputs: Number of raw outputs m.
        settings: Layers, activation, features and start weights.
        seed: Seed of the start weights.
    """

    def __init__(self, n: int, outputs: int, settings: NetworkSettings, seed: int) -> None:
        super().__init__()
        self._sincos = settings.features == "sincos"
        self._activation = ACTIVATIONS[settings.activation]
        widths = (2 * n if self._sincos else n, *settings.hidden, outputs)
        random = torch.Generator().manual_seed(seed)
        self.layers: Any = nn.ModuleList(
            _layer(inputs, units, settings.hidden_gain, settings.bias, random)
            for inputs, units in pairwise(widths[:-1])
        )
        self.last = _layer(widths[-2], outputs, settings.output_gain, settings.bias, random)

    def forward(self, q: Tensor) -> Tensor:
        """Return the raw outputs (B, m) for q (B, n)."""
        value = self._features(q)[0]
        for layer in self.layers:
            value, _ = self._activation(layer(value))
        return self._out(value)

    def along(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """Return raw outputs and their rates of change, both (B, m), and the tape."""
        value, turns = self._features(q)
        rate = torch.cat([-turns[1] * qd, turns[0] * qd], dim=-1) if turns else qd
        slopes = []
        for layer in self.layers:
            value, slope = self._activation(layer(value))
            rate = slope * functional.linear(rate, layer.weight)
            slopes.append(slope)
        tape = Tape(tuple(slopes), turns)
        return self._out(value), functional.linear(rate, self.last.weight), tape

    def pull_back(self, cotangent: Tensor, tape: Tape) -> Tensor:
        """Return the gradient of a scalar by q (B, n).

        Args:
            cotangent: Gradient (B, k) of the scalar by the first k raw outputs.
            tape: Intermediate results of the forward pass through the layers.
        """
        found = cotangent @ self.last.weight[: cotangent.shape[-1]]
        for layer, slope in zip(reversed(self.layers), reversed(tape.slopes), strict=True):
            found = (found * slope) @ layer.weight
        if not tape.turns:
            return found
        by_cos, by_sin = found.chunk(2, dim=-1)
        return tape.turns[0] * by_sin - tape.turns[1] * by_cos

    def _features(self, q: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        if not self._sincos:
            return q, ()
        turns = (torch.cos(q), torch.sin(q))
        return torch.cat(turns, dim=-1), turns

    def _out(self, value: Tensor) -> Tensor:
        return functional.linear(value, self.last.weight, self.last.bias)


def _layer(inputs: int, units: int, gain: float, bias: float, random: torch.Generator) -> nn.Linear:
    """Return a linear layer with start weights after Glorot (2010), drawn from `random`.

    The creation of the layer does not change the global random generator of torch.
    """
    layer = nn.Linear(inputs, units, device="meta").to_empty(device="cpu")
    spread = gain * (2.0 / (inputs + units)) ** 0.5
    drawn = torch.randn((units, inputs), generator=random, dtype=torch.float64)
    with torch.no_grad():
        layer.weight.copy_(spread * drawn)
        layer.bias.fill_(bias)
    return layer


class Factor(nn.Module):
    """Lower triangular matrix L from n(n+1)/2 raw outputs, of which the first n are the diagonal.

    A product with a constant matrix moves each entry to its position in L and multiplies the entry
    by the unit of its row. Every exporter supports a product with a constant matrix.

    Args:
        n: Number of joints.
        settings: Settings of the network, of which the activation of the diagonal and epsilon are
            used.
        unit: (n,) units of the rows of L, in √(N·m s²).

    Attributes:
        entries: Number of raw outputs that form L.
    """

    placement: Tensor

    def __init__(self, n: int, settings: NetworkSettings, unit: Tensor) -> None:
        super().__init__()
        self._n = n
        self.entries = n * (n + 1) // 2
        self._diagonal = softplus if settings.diagonal == "softplus" else relu
        of_factor = settings.epsilon_of == "factor"
        self._least = settings.epsilon if of_factor else 0.0
        self._added = 0.0 if of_factor else settings.epsilon
        self.register_buffer("placement", _placement(n, unit), persistent=False)

    def forward(self, raw: Tensor) -> Tensor:
        """Return L (B, n, n)."""
        return self._placed(self._entries(raw)[0])

    def along(self, raw: Tensor, rate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return L and its rate of change (B, n, n), and the slopes of its diagonal (B, n)."""
        entries, slope = self._entries(raw)
        rates = torch.cat([slope * rate[..., : self._n], rate[..., self._n : self.entries]], -1)
        return self._placed(entries), self._placed(rates), slope

    def pull_back(self, cotangent: Tensor, slope: Tensor) -> Tensor:
        """Return the gradient (B, n(n+1)/2) by the raw outputs from the gradient (B, n, n) by L."""
        found = cotangent.flatten(-2) @ self.placement.mT
        return torch.cat([slope * found[..., : self._n], found[..., self._n :]], -1)

    def mass(self, factor: Tensor) -> Tensor:
        """Return M (B, n, n) for L."""
        return factor @ factor.mT + self._added * torch.eye(self._n).to(factor)

    def momentum(self, factor: Tensor, turned: Tensor, velocity: Tensor) -> Tensor:
        """Return M·v (B, n) from u = Lᵀv (B, n) and v, without computing M."""
        found = times(factor, turned)
        return found + self._added * velocity if self._added else found

    def _entries(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        diagonal, slope = self._diagonal(raw[..., : self._n])
        return torch.cat([diagonal + self._least, raw[..., self._n : self.entries]], -1), slope

    def _placed(self, entries: Tensor) -> Tensor:
        flat = entries @ self.placement
        return flat.reshape(*flat.shape[:-1], self._n, self._n)


def _placement(n: int, unit: Tensor) -> Tensor:
    """Return the matrix (n(n+1)/2, n²) that places the entries of L and applies the row units."""
    rows, columns = torch.tril_indices(n, n, offset=-1)
    rows, columns = torch.cat([torch.arange(n), rows]), torch.cat([torch.arange(n), columns])
    found = torch.zeros(len(rows), n * n)
    found[torch.arange(len(rows)), rows * n + columns] = unit[rows].to(found)
    return found


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return A·v (B, n) for matrices (B, n, n) and vectors (B, n)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


class Torques(NamedTuple):
    """Parts of the torque, each (B, n) [N·m]; the sum of the parts is the torque."""

    inertia: Tensor
    coriolis: Tensor
    gravity: Tensor
    friction: Tensor


class NetworkModel(nn.Module):
    """Network that predicts the torque of a motion: M(q)·q̈ + C(q, q̇)·q̇ + g(q) + friction.

    Args:
        design: Design of the Lagrangian part and of the friction part.
        torque_std: (n,) standard deviation of each joint's torque [N·m].
        seed: Seed of the start weights.
    """

    def __init__(self, design: Design, torque_std: FloatArray, seed: int = 0) -> None:
        super().__init__()
        n = len(torque_std)
        self.dynamics = LagrangianNetwork(n, design.network, torque_std, seed)
        self.friction = friction_network(design.kind, n, torque_std, design.friction, seed)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, direction: Tensor) -> Tensor:
        """Return the torque (B, n) [N·m]."""
        torque: Tensor = self.dynamics(q, qd, qdd) + self.friction(q, qd, direction)
        return torque

    def torques(self, q: Tensor, qd: Tensor, qdd: Tensor, direction: Tensor) -> Torques:
        """Return the parts of the torque (inertia, Coriolis, gravity, friction) separately."""
        parts = self.dynamics.parts(q, qd, qdd)
        friction = self.friction(q, qd, direction)
        return Torques(parts.inertia, parts.coriolis, parts.gravity, friction)

    def groups(self) -> dict[str, Sequence[nn.Parameter]]:
        """Return the parameters, grouped by the name of the part that a stage trains or freezes."""
        parts = {"dynamics": self.dynamics, "friction": self.friction}
        found = {name: tuple(part.parameters()) for name, part in parts.items()}
        return {name: parameters for name, parameters in found.items() if parameters}


Weights = Mapping[str, np.ndarray[Any, Any]]


def network_of(design: Design, torque_std: FloatArray, weights: Weights) -> NetworkModel:
    """Return the network with its stored weights, on the CPU and in the precision of the weights.

    Raises:
        ValueError: A weight is missing, superfluous, of a wrong shape or not finite.
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


def _require_room(design: Design, weights: Weights) -> None:
    """Raise if the design needs more weights than are stored, before memory is allocated."""
    layers = [design.network.hidden]
    if design.kind in ("dissipative", "unconstrained"):
        layers.append(design.friction.hidden)
    needed = sum(sum(units) + sum(a * b for a, b in pairwise(units)) for units in layers)
    stored = sum(value.size for value in weights.values())
    if needed > stored:
        raise ValueError(
            f"hidden: the network needs at least {needed} weights, but {stored} are stored"
        )


def _require_alike(name: str, value: np.ndarray[Any, Any], wanted: np.ndarray[Any, Any]) -> None:
    if value.shape != wanted.shape:
        raise ValueError(
            f"weights: {name} has the shape {value.shape}, but the network needs {wanted.shape}"
        )
    if value.dtype.kind != wanted.dtype.kind:
        raise ValueError(
            f"weights: {name} has the type {value.dtype}, but the network needs {wanted.dtype}"
        )
    # Integer buffers are matrix indices, which follow from the design.
    if wanted.dtype.kind == "i" and not np.array_equal(value, wanted):
        raise ValueError(f"weights: {name} does not match the network")
    if not np.all(np.isfinite(value)):
        raise ValueError(f"weights: {name} contains values that are not finite")


AT_ONCE = 2048
"""Number of rows per pass, which limits memory; a higher number would not be faster."""


def torques(module: NetworkModel, *motion: FloatArray) -> dict[str, FloatArray]:
    """Return the parts of the torque by name, each (N, n) [N·m].

    Args:
        module: Network on the CPU.
        *motion: Position, velocity, acceleration and direction, each (N, n).
    """
    found = {name: np.empty(motion[0].shape) for name in Torques._fields}
    with torch.inference_mode(), reproducible(torch.device("cpu"), 1):
        for first in range(0, len(motion[0]), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            parts = module.torques(*(_tensor(module, values[rows]) for values in motion))
            for name, values in parts._asdict().items():
                found[name][rows] = values.numpy()
    return found


def steady_friction(module: NetworkModel, qd: FloatArray, direction: FloatArray) -> FloatArray:
    """Return friction (N, n) [N·m] at velocities and directions (N, n), evaluated at q = 0.

    The returned curve is meaningful only for friction that does not depend on the position.
    """
    with torch.inference_mode():
        parts = [_tensor(module, values) for values in (np.zeros_like(qd), qd, direction)]
        return np.asarray(module.friction(*parts).double().numpy())


def mass_matrix(module: NetworkModel, q: FloatArray) -> FloatArray:
    """Return M(q) (N, n, n) [kg·m²] at positions (N, n)."""
    with torch.inference_mode(), reproducible(torch.device("cpu"), 1):
        return np.asarray(module.dynamics.mass(_tensor(module, q)).double().numpy())


def _tensor(module: NetworkModel, values: FloatArray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=next(module.parameters()).dtype)


LoadTorque = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Function from a motion, three arrays (1, n), to the torque of the load (1, n) [N·m]."""


class NetworkStream:
    """Predictor for one sample at a time, which also updates Dahl's state if the network uses it.

    Args:
        module: Network on the CPU.
        width: Width of the smooth sign [rad/s].
        length: (n,) characteristic length of Dahl's state [rad]; None if the direction is the
            smooth sign.
        load: Function that returns the torque of the mounted load; None without a load.
        scale: (n,) torque per unit of effort.
    """

    def __init__(
        self,
        module: NetworkModel,
        width: float,
        length: FloatArray | None,
        load: LoadTorque | None,
        scale: FloatArray,
    ) -> None:
        self._module, self._width = module, width
        self._load, self._scale = load, scale
        self._memory = None if length is None else DahlMemory(length, [1.0])

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the predicted effort (n,) for one sample.

        Args:
            q: (n,) position [rad].
            qd: (n,) velocity [rad/s]; a velocity of exactly 0 leaves Dahl's state unchanged.
            qdd: (n,) acceleration [rad/s²].

        Raises:
            DataError: An input does not have one number per joint.
        """
        motion = one_sample(len(self._scale), q, qd, qdd)
        direction = self._direction(motion[0], motion[1])
        with torch.inference_mode():
            inputs = (_tensor(self._module, values) for values in (*motion, direction))
            torque = self._module(*inputs).double().numpy()
        if self._load is not None:
            torque = torque + self._load(*motion)
        sample: FloatArray = (torque / self._scale)[0]
        return sample

    def _direction(self, q: FloatArray, qd: FloatArray) -> FloatArray:
        if self._memory is None:
            return smooth_sign(qd, self._width)
        return self._memory.after(q, qd)[1.0]


VALIDATED_AT_ONCE = 4096
"""Number of rows per validation pass, which limits memory."""


class LagrangianProblem:
    """Training problem for `hil.networks.training_loop.train`: a network and its dataset rows.

    Args:
        module: Network on the device on which it is trained.
        learn, validate: Training rows and validation rows, on the same device as the network.
        loss: Loss that is minimised on the training rows; the value of the loss on the validation
            rows decides when the training stops. The loss uses prediction errors relative to each
            joint's standard deviation, or is the error measure of the PINN paper.
    """

    def __init__(self, module: NetworkModel, learn: Rows, validate: Rows, loss: Loss) -> None:
        self.module: NetworkModel = module
        self.samples = len(learn)
        self._learn, self._validate, self._loss = learn, validate, loss

    def groups(self) -> Mapping[str, Sequence[torch.nn.Parameter]]:
        """Return the parameter groups: `dynamics` and, if friction has parameters, `friction`."""
        return self.module.groups()

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        """Return the mean loss of the rows whose numbers (B,) are passed."""
        rows = self._learn.take(chosen)
        return self._loss(self.module(*rows.motion), rows.torque)

    def validate(self) -> float:
        """Return the mean loss over the validation rows."""
        total = 0.0
        for first in range(0, len(self._validate), VALIDATED_AT_ONCE):
            rows = self._validate.take(slice(first, first + VALIDATED_AT_ONCE))
            total += float(self._loss(self.module(*rows.motion), rows.torque)) * len(rows)
        return total / len(self._validate)


def problem(task: Task, design: Design, training: TrainingSettings) -> LagrangianProblem:
    """Return a training problem with an untrained network and its rows in memory.

    Raises:
        SpecError: torch does not have the requested device.
    """
    device, dtype = torch_device(training.device), torch_dtype(training.precision)
    module = NetworkModel(design, task.torque_std, training.seed).to(device, dtype)
    learn, validate = (
        tensor_rows(task.data, task.torque, wanted, dtype=dtype, device=device)
        for wanted in (task.learn, task.validate)
    )
    return LagrangianProblem(module, learn, validate, Loss(training.loss, task.torque_std))


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Network inputs of some dataset rows, and the torque that the network should predict.

    Attributes:
        motion: Position, velocity, acceleration and direction, each (N, n).
        torque: (N, n) torque [N·m], without the torque of declared loads.
    """

    motion: tuple[torch.Tensor, ...]
    torque: torch.Tensor

    def __len__(self) -> int:
        return len(self.torque)

    def take(self, chosen: torch.Tensor | slice) -> Rows:
        """Return the rows with the numbers (B,), or the rows of a slice."""
        return Rows(tuple(column[chosen] for column in self.motion), self.torque[chosen])


def tensor_rows(
    data: Dataset,
    torque: FloatArray,
    wanted: BoolArray,
    *,
    dtype: torch.dtype,
    device: torch.device,
) -> Rows:
    """Return the selected rows (N,) of a prepared dataset that has the column `DIRECTION`."""

    def tensor(values: FloatArray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values[wanted]), dtype=dtype, device=device)

    return Rows(tuple(tensor(data[name]) for name in (*MOTION, DIRECTION)), tensor(torque))


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """Result of the trial with the lowest validation error.

    Attributes:
        weights: Weights and scales of the network by name.
        curves: Learning curves of the trial.
        notes: Notes with the results of all trials; empty if there was only one trial.
    """

    weights: dict[str, np.ndarray[Any, Any]]
    curves: Curves
    notes: tuple[str, ...] = ()


def fit_network(
    task: Task,
    design: Design,
    stages: Sequence[Stage],
    trials: Sequence[TrainingSettings],
    watch: Watch | None = None,
    checkpoints: Path | None = None,
) -> Trained:
    """Train one network per trial from the same start weights; return the most accurate network.

    Trials whose training diverges are discarded.

    Args:
        task: Training and validation rows.
        design: Design of the network.
        stages: Stages of every trial.
        trials: Training settings of each trial; usually the list has one entry.
        watch: Function that is called with every epoch.
        checkpoints: Folder for the checkpoints; if there are several trials, each gets a subfolder.

    Raises:
        FitError: Every trial diverges.
        SpecError: torch does not have the requested device.
    """
    if len(trials) == 1:
        return _trained(task, design, stages, trials[0], watch or unwatched, checkpoints)
    found, notes, errors = [], [], []
    for number, training in enumerate(trials, start=1):
        which = f"trial {number} of {len(trials)}"
        kept = None if checkpoints is None else checkpoints / f"trial-{number}"
        try:
            one = _trained(task, design, stages, training, _named(watch, which), kept)
        except FitError as error:
            errors.append(error)
            notes.append(f"{which}, {_rate(training)}: {error.message}")
            continue
        found.append(one)
        notes.append(f"{which}, {_rate(training)}: validation error {one.curves.best:.4g}")
    if not found:
        raise errors[0]
    return replace(min(found, key=lambda one: one.curves.best), notes=tuple(notes))


def _trained(
    task: Task,
    design: Design,
    stages: Sequence[Stage],
    training: TrainingSettings,
    watch: Watch,
    checkpoints: Path | None,
) -> Trained:
    posed = problem(task, design, training)
    curves = train(posed, stages, training, watch, checkpoints)
    return Trained(weights_of(posed.module), curves)


def _named(watch: Watch | None, which: str) -> Watch:
    if watch is None:
        return unwatched
    return lambda told: watch(replace(told, stage=f"{which}: {told.stage}"))


def _rate(training: TrainingSettings) -> str:
    return f"friction at {training.group_rates.get(FRICTION, 1.0):g} of the learning rate"


def weights_of(module: nn.Module) -> dict[str, np.ndarray[Any, Any]]:
    """Return all weights and scales of the network by name."""
    return {name: value.detach().cpu().numpy() for name, value in module.state_dict().items()}
