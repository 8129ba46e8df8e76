"""Joint friction as a part of a network, trained together with the Lagrangian network beside it.

Two laws have a few intrinsic parameters: Coulomb–viscous (eq. 3) and Stribeck (eq. 15–18). Both
have the sign of `direction`: the caller decides whether it is memoryless (a smooth sign of the
velocity) or has a hysteresis (Dahl's state). Two are networks of their own (Gupta et al., 2020):
one that can only take power, and one without that constraint. `friction_network` makes them all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.estimators import choice
from hil.networks.lagrangian_settings import FRICTIONS, FrictionKind, FrictionSettings


class FrictionNetwork(Protocol):
    """What every friction of `friction_network` can do."""

    def __call__(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) friction torque [N·m] at positions, velocities and directions (B, n)."""

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] of each joint at a steady speed (K, n) [rad/s], others at rest."""

    def intrinsic(self) -> dict[str, FloatArray]:
        """(n,) values of the parameters that mean something, by name."""


def friction_network(
    kind: FrictionKind,
    n: int,
    torque_scale: FloatArray,
    settings: FrictionSettings | None = None,
    seed: int = 0,
) -> nn.Module:
    """Friction of n joints, a `FrictionNetwork`.

    Args:
        kind: One of `FRICTIONS`.
        n: Joints.
        torque_scale: (n,) standard deviation of each joint's torque [N·m].
        settings: How it is parametrised.
        seed: Of start weights, where there are any.

    Raises:
        SpecError: There is no such kind.
    """
    choice("friction", kind, FRICTIONS)
    settings = settings or FrictionSettings()
    if kind == "coulomb":
        return CoulombViscous(_units(n, torque_scale, settings), settings)
    if kind == "stribeck":
        return Stribeck(_units(n, torque_scale, settings), settings)
    if kind == "none":
        return NoFriction()
    network = Dissipative if kind == "dissipative" else Unconstrained
    return network(n, torque_scale, settings, seed)


LEAST_SPEED = 1e-6
"""Slower than this [rad/s] counts as this: d|v|^α/dα = |v|^α·ln|v| is no number at rest."""

LEAST_STRIBECK_SPEED = 1e-3
"""v_s of free parameters comes no nearer to 0 than this [rad/s]."""

LARGEST_EXPONENT = 20.0
"""e to this is 5e8: larger powers than that count as that, in single precision too."""


class CoulombViscous(nn.Module):
    """f_c·direction + f_v·q̇ + offset (eq. 3; Lahoud et al., 2024).

    Args:
        units: (n,) of the coefficients [N·m].
        settings: How they are parametrised.
    """

    def __init__(self, units: FloatArray, settings: FrictionSettings) -> None:
        super().__init__()
        self._hard = settings.sign == "hard"
        self.f_c, self.f_v = (_coefficient(units, settings) for _ in range(2))
        self.offset = Free(units, 0.0)

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        sign = torch.sign(qd) if self._hard else direction
        torque: Tensor = self.f_c() * sign + self.f_v() * qd + self.offset()
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] at steady speeds (K, n) [rad/s]."""
        return _steady(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """f_c [N·m], f_v [N·m·s/rad] and offset [N·m], each (n,)."""
        return _values(f_c=self.f_c, f_v=self.f_v, offset=self.offset)


class Stribeck(nn.Module):
    """direction·[λ·f_s + (1 − λ)·f_c + f_v·|q̇|^α] with λ = exp(−|q̇/v_s|^δ_s) (eq. 16–18).

    With bounds no factor of `direction` is negative: friction takes power, never gives any, as
    long as `direction` has the sign of the velocity. The offset is no friction and not bound.

    Args:
        units: (n,) of the coefficients [N·m].
        settings: How they are parametrised.
    """

    def __init__(self, units: FloatArray, settings: FrictionSettings) -> None:
        super().__init__()
        self._hard, n = settings.sign == "hard", len(units)
        self.f_s, self.f_c, self.f_v = (_coefficient(units, settings) for _ in range(3))
        self.v_s = _shape(n, settings, settings.speed_bounds, settings.start_speed)
        self.delta_s = _shape(n, settings, settings.shape_bounds, settings.start_shape)
        self.alpha = _shape(n, settings, settings.exponent_bounds, settings.start_exponent)
        self.offset = Free(units, 0.0) if settings.offset else None

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        speed = qd.abs().clamp_min(LEAST_SPEED)
        share = torch.exp(-_power(speed / self._stribeck_speed(), self.delta_s()))
        f_c = self.f_c()
        size = f_c + (self.f_s() - f_c) * share + self.f_v() * _power(speed, self.alpha())
        torque: Tensor = (torch.sign(qd) if self._hard else direction) * size
        return torque if self.offset is None else torque + self.offset()

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] at steady speeds (K, n) [rad/s]."""
        return _steady(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """f_s, f_c, f_v, offset [N·m], v_s [rad/s], delta_s, alpha, each (n,)."""
        names = ("f_s", "f_c", "f_v", "delta_s", "alpha", "offset")
        parameters = {name: getattr(self, name) for name in names}
        return _values(v_s=self._stribeck_speed, **parameters)

    def _stribeck_speed(self) -> Tensor:
        """(n,) v_s [rad/s]: a free parameter may be negative or 0, the speed it stands for not."""
        speed: Tensor = self.v_s().abs().clamp_min(LEAST_STRIBECK_SPEED)
        return speed


def _units(n: int, torque_scale: FloatArray, settings: FrictionSettings) -> FloatArray:
    return settings.unit * np.asarray(torque_scale) if settings.scaled else np.ones(n)


def _coefficient(units: FloatArray, settings: FrictionSettings) -> nn.Module:
    kind = NotNegative if settings.bounded else Free
    return kind(units, 1.0 if settings.scaled else settings.start)


def _shape(
    n: int, settings: FrictionSettings, bounds: tuple[float, float], start: float
) -> nn.Module:
    return Between(n, bounds, start) if settings.bounded else Free(np.ones(n), start)


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    """base^exponent of a positive base, with finite gradients whatever the exponent is."""
    return torch.exp((exponent * torch.log(base)).clamp_max(LARGEST_EXPONENT))


def _steady(network: nn.Module, speeds: FloatArray) -> FloatArray:
    """At steady speed Dahl's state and a smooth sign have both come to the sign."""
    with torch.no_grad():
        parameter = next(network.parameters())
        qd = torch.as_tensor(speeds, dtype=parameter.dtype, device=parameter.device)
        torque = network(torch.zeros_like(qd), qd, torch.sign(qd))
    return np.asarray(torque.double().cpu().numpy())


def _values(**parameters: Callable[[], Tensor] | None) -> dict[str, FloatArray]:
    with torch.no_grad():
        return {
            name: np.asarray(parameter().double().cpu().numpy())
            for name, parameter in parameters.items()
            if parameter is not None
        }


class NoFriction(nn.Module):
    """None: what a Lagrangian network alone is (Lutter et al., 2019)."""

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) zeros."""
        return torch.zeros_like(qd)

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) zeros."""
        return np.zeros_like(speeds, dtype=np.float64)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing."""
        return {}


LEAST_REST_SPEED = 1e-4
"""Where a hard sign is asked for [rad/s]: at rest 1/|q̇| is no number."""


class Dissipative(nn.Module):
    """D(q, q̇)·q̇ with D = A·Aᵀ ⪰ 0: friction that cannot give power, whatever its weights are.

    Friction hardly depends on the size of a velocity, so damping must go as 1/|q̇|, which a smooth
    network of q̇ cannot learn: its error on left-out trajectories is four times as large. Each row
    of A therefore has the factor (|q̇ᵢ| + `rest_speed`)^−½ and what a network of q and log|q̇| says:
    D stays ⪰ 0, and starts as Coulomb friction of unit·torque_scale in every joint.

    Args:
        n: Joints.
        torque_scale: (n,) standard deviation of each joint's torque [N·m].
        settings: Widths of its hidden layers, the unit, and below what speed damping stays.
        seed: Of the start weights.
    """

    scale: Tensor
    places: Tensor

    def __init__(
        self, n: int, torque_scale: FloatArray, settings: FrictionSettings, seed: int
    ) -> None:
        super().__init__()
        rows, columns = np.tril_indices(n)
        self.network = _perceptron((3 * n, *settings.hidden, len(rows)), seed)
        with torch.no_grad():
            start = np.where(rows == columns, np.sqrt(settings.unit), 0.0)
            last = self.network[-1]
            assert isinstance(last, nn.Linear)
            last.bias.copy_(torch.as_tensor(start))
        roots = np.sqrt(_scale(n, torque_scale, settings))[rows]
        self.register_buffer("scale", torch.as_tensor(roots, dtype=torch.get_default_dtype()))
        self.register_buffer("places", torch.as_tensor(rows * n + columns))
        self._n, self._rest = n, max(settings.rest_speed, LEAST_REST_SPEED)

    def factor(self, q: Tensor, qd: Tensor) -> Tensor:
        """(B, n, n) lower triangle A."""
        speed = qd.abs() + self._rest
        entries: Tensor = self.network(_inputs(q, torch.log(speed))) * self.scale
        flat = entries.new_zeros(len(q), self._n * self._n)
        lower = flat.index_copy(1, self.places, entries).view(-1, self._n, self._n)
        return lower * torch.rsqrt(speed)[..., None]

    def damping(self, q: Tensor, qd: Tensor) -> Tensor:
        """(B, n, n) D [N·m·s/rad]."""
        A = self.factor(q, qd)
        damping: Tensor = A @ A.mT
        return damping

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        A = self.factor(q, qd)
        torque: Tensor = (A @ (A.mT @ qd[..., None]))[..., 0]
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] of each joint moving alone at q = 0, at speeds (K, n) [rad/s]."""
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing: no weight means anything by itself."""
        return {}


SHARPNESS = 4.0
"""Of the softplus: a coefficient about its unit moves 0.98 times as fast as its parameter."""


class Free(nn.Module):
    """Any value: unit·θ.

    Args:
        unit: (n,) of the value.
        start: Of the value, in units.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        self.theta = nn.Parameter(torch.full((len(unit),), start))

    def forward(self) -> Tensor:
        """(n,) values."""
        return self.unit * self.theta


class NotNegative(nn.Module):
    """A value that cannot fall below 0: unit·softplus(θ).

    Args:
        unit: (n,) of the value.
        start: Of the value, in units, above 0.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        theta = math.log(math.expm1(SHARPNESS * start)) / SHARPNESS
        self.theta = nn.Parameter(torch.full((len(unit),), theta))

    def forward(self) -> Tensor:
        """(n,) values."""
        return self.unit * nn.functional.softplus(self.theta, beta=SHARPNESS)


class Between(nn.Module):
    """A positive value within bounds, which its logarithm moves between.

    Args:
        n: How many.
        bounds: Lowest and highest, above 0.
        start: Within them.
    """

    def __init__(self, n: int, bounds: tuple[float, float], start: float) -> None:
        super().__init__()
        self.low, self.span = math.log(bounds[0]), math.log(bounds[1] / bounds[0])
        share = math.log(start / bounds[0]) / self.span
        self.theta = nn.Parameter(torch.full((n,), math.log(share / (1.0 - share))))

    def forward(self) -> Tensor:
        """(n,) values."""
        return torch.exp(self.low + self.span * torch.sigmoid(self.theta))


class Unconstrained(nn.Module):
    """Any torque that depends on position and velocity, as published: it may drive the arm.

    Args:
        n: Joints.
        torque_scale: (n,) unit of its outputs [N·m].
        settings: Widths of its hidden layers, and whether it has that unit.
        seed: Of the start weights.
    """

    scale: Tensor

    def __init__(
        self, n: int, torque_scale: FloatArray, settings: FrictionSettings, seed: int
    ) -> None:
        super().__init__()
        self.network = _perceptron((3 * n, *settings.hidden, n), seed)
        scale = _scale(n, torque_scale, settings)
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.get_default_dtype()))

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        torque: Tensor = self.network(_inputs(q, qd)) * self.scale
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] of each joint moving alone at q = 0, at speeds (K, n) [rad/s]."""
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing: no weight means anything by itself."""
        return {}


def _perceptron(widths: tuple[int, ...], seed: int) -> nn.Sequential:
    """Layers of tanh and a linear one, from a seed of their own."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def _scale(n: int, torque_scale: FloatArray, settings: FrictionSettings) -> FloatArray:
    return np.asarray(torque_scale, dtype=np.float64) if settings.scaled else np.ones(n)


def _inputs(q: Tensor, velocity: Tensor) -> Tensor:
    return torch.cat([torch.cos(q), torch.sin(q), velocity], dim=-1)


def _alone(network: nn.Module, speeds: FloatArray) -> FloatArray:
    curves = np.zeros_like(speeds, dtype=np.float64)
    with torch.no_grad():
        parameter = next(network.parameters())
        for joint, speed in enumerate(np.asarray(speeds).T):
            qd = torch.zeros(speeds.shape, dtype=parameter.dtype, device=parameter.device)
            qd[:, joint] = torch.as_tensor(speed)
            torque = network(torch.zeros_like(qd), qd, torch.sign(qd))
            curves[:, joint] = torque[:, joint].double().cpu().numpy()
    return curves
