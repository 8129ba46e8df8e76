"""Joint friction models that are trained together with a Lagrangian network.

Two of the friction models are laws with a few intrinsic parameters: Coulomb–viscous (eq. 3) and
Stribeck (eq. 15–18). The Coulomb–viscous law and the Stribeck law use the sign of `direction`. The
caller passes a direction without memory (a smooth sign of the velocity) or a direction with
hysteresis (Dahl's state). Two friction models are neural networks (Gupta et al., 2020):
`dissipative` can only dissipate power, `unconstrained` can also generate power. The function
`friction_network` creates any of the friction models.
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
    """Common interface of all friction models that `friction_network` creates."""

    def __call__(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """Return friction torque (B, n) [N·m] at positions, velocities and directions (B, n)."""

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return the torque (K, n) [N·m] of each joint at steady speeds (K, n) [rad/s].

        For the torque of a joint, all other joints are assumed to be at standstill.
        """

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return the friction parameters that have a physical meaning, by name, each (n,)."""


def friction_network(
    kind: FrictionKind,
    n: int,
    torque_scale: FloatArray,
    settings: FrictionSettings | None = None,
    seed: int = 0,
) -> nn.Module:
    """Return a friction model of n joints, which is a `FrictionNetwork`.

    Args:
        kind: One of `FRICTIONS`.
        n: Number of joints.
        torque_scale: (n,) standard deviation of each joint's torque [N·m].
        settings: Parametrisation of the friction; None means the default settings.
        seed: Seed of the start weights of `dissipative` and `unconstrained` friction.

    Raises:
        SpecError: The friction kind is unknown.
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
"""Minimum of the speed |v| [rad/s], because d|v|^α/dα = |v|^α·ln|v| is undefined at v = 0."""

LEAST_STRIBECK_SPEED = 1e-3
"""Minimum of |v_s| [rad/s] if the parameters have no bounds."""

LARGEST_EXPONENT = 20.0
"""Maximum of the exponent of e in a power; e²⁰ ≈ 5e8 is finite in single precision too."""


class CoulombViscous(nn.Module):
    """Friction law f_c·direction + f_v·q̇ + offset (eq. 3; Lahoud et al., 2024).

    Args:
        units: (n,) units of the coefficients [N·m].
        settings: Parametrisation of the coefficients: bounds, units and start values.
    """

    def __init__(self, units: FloatArray, settings: FrictionSettings) -> None:
        super().__init__()
        self._hard = settings.sign == "hard"
        self.f_c, self.f_v = (_coefficient(units, settings) for _ in range(2))
        self.offset = Free(units, 0.0)

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """Return the friction torque (B, n) [N·m]."""
        sign = torch.sign(qd) if self._hard else direction
        torque: Tensor = self.f_c() * sign + self.f_v() * qd + self.offset()
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return the friction torque (K, n) [N·m] at steady speeds (K, n) [rad/s]."""
        return _steady(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return the coefficients f_c [N·m], f_v [N·m·s/rad] and offset [N·m], each (n,)."""
        return _values(f_c=self.f_c, f_v=self.f_v, offset=self.offset)


class Stribeck(nn.Module):
    """Stribeck friction law (eq. 16–18).

    The torque is direction·[λ·f_s + (1 − λ)·f_c + f_v·|q̇|^α] with λ = exp(−|q̇/v_s|^δ_s). With
    bounds on the parameters, the factor of `direction` is never negative. With bounded parameters,
    friction only dissipates power, as long as `direction` has the sign of the velocity. The
    constant offset of the Stribeck law does not count as friction and is not bounded.

    Args:
        units: (n,) units of the coefficients [N·m].
        settings: Parametrisation of the coefficients: bounds, units and start values.
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
        """Return the friction torque (B, n) [N·m]."""
        speed = qd.abs().clamp_min(LEAST_SPEED)
        share = torch.exp(-_power(speed / self._stribeck_speed(), self.delta_s()))
        f_c = self.f_c()
        size = f_c + (self.f_s() - f_c) * share + self.f_v() * _power(speed, self.alpha())
        torque: Tensor = (torch.sign(qd) if self._hard else direction) * size
        return torque if self.offset is None else torque + self.offset()

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return the friction torque (K, n) [N·m] at steady speeds (K, n) [rad/s]."""
        return _steady(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return f_s, f_c, f_v, offset [N·m], v_s [rad/s], delta_s and alpha, each (n,)."""
        names = ("f_s", "f_c", "f_v", "delta_s", "alpha", "offset")
        parameters = {name: getattr(self, name) for name in names}
        return _values(v_s=self._stribeck_speed, **parameters)

    def _stribeck_speed(self) -> Tensor:
        """Return the velocity v_s (n,) [rad/s], positive even if the parameter is negative."""
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
    """Return base^exponent for a positive base, with finite gradients for any exponent."""
    return torch.exp((exponent * torch.log(base)).clamp_max(LARGEST_EXPONENT))


def _steady(network: nn.Module, speeds: FloatArray) -> FloatArray:
    """Return the torque (K, n) at steady speed, at which Dahl's state equals sign(q̇)."""
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
    """Friction model with zero friction, as in a Lagrangian network alone (Lutter et al., 2019)."""

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """Return zeros (B, n)."""
        return torch.zeros_like(qd)

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return zeros (K, n)."""
        return np.zeros_like(speeds, dtype=np.float64)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return an empty dictionary, because zero friction has no parameters."""
        return {}


LEAST_REST_SPEED = 1e-4
"""Minimum of `rest_speed` [rad/s], because 1/|q̇| is undefined at standstill."""


class Dissipative(nn.Module):
    """Friction D(q, q̇)·q̇ with D = A·Aᵀ ⪰ 0, which cannot generate power for any weights.

    Friction hardly depends on the magnitude of the velocity, so the damping must vary as 1/|q̇|. A
    smooth network of q̇ cannot learn a damping that varies as 1/|q̇|, and has four times the error
    on held-out trajectories. Each row i of A is therefore the product of (|q̇ᵢ| + `rest_speed`)^−½
    and the output of a network of q and log|q̇|. The damping D remains ⪰ 0, and initially
    corresponds to Coulomb friction of unit·torque_scale in every joint.

    Args:
        n: Number of joints.
        torque_scale: (n,) standard deviation of each joint's torque [N·m].
        settings: Widths of the hidden layers, unit, and speed below which the damping stays
            constant.
        seed: Seed of the start weights.
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
        """Return the lower triangular matrix A (B, n, n)."""
        speed = qd.abs() + self._rest
        entries: Tensor = self.network(_inputs(q, torch.log(speed))) * self.scale
        flat = entries.new_zeros(len(q), self._n * self._n)
        lower = flat.index_copy(1, self.places, entries).view(-1, self._n, self._n)
        return lower * torch.rsqrt(speed)[..., None]

    def damping(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the damping matrix D (B, n, n) [N·m·s/rad]."""
        A = self.factor(q, qd)
        damping: Tensor = A @ A.mT
        return damping

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """Return the friction torque (B, n) [N·m]."""
        A = self.factor(q, qd)
        torque: Tensor = (A @ (A.mT @ qd[..., None]))[..., 0]
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return the torque (K, n) [N·m] of each joint at speeds (K, n) [rad/s].

        For the torque of a joint, q is 0 and all other joints are assumed to be at standstill.
        """
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return an empty dictionary, because weights have no physical meaning."""
        return {}


SHARPNESS = 4.0
"""Sharpness β of the softplus; near its unit, a coefficient changes 0.98 times as fast as θ."""


class Free(nn.Module):
    """Unbounded parameter: unit·θ.

    Args:
        unit: (n,) unit of the parameter.
        start: Start value of the parameter, as a multiple of `unit`.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        self.theta = nn.Parameter(torch.full((len(unit),), start))

    def forward(self) -> Tensor:
        """Return the values (n,)."""
        return self.unit * self.theta


class NotNegative(nn.Module):
    """Non-negative parameter: unit·softplus(θ).

    Args:
        unit: (n,) unit of the parameter.
        start: Start value of the parameter, as a multiple of `unit`; above 0.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        theta = math.log(math.expm1(SHARPNESS * start)) / SHARPNESS
        self.theta = nn.Parameter(torch.full((len(unit),), theta))

    def forward(self) -> Tensor:
        """Return the values (n,)."""
        return self.unit * nn.functional.softplus(self.theta, beta=SHARPNESS)


class Between(nn.Module):
    """Positive parameter within two bounds, interpolated between the bounds on a logarithmic scale.

    Args:
        n: Number of values.
        bounds: Lowest and highest value of the parameter, above 0.
        start: Start value of the parameter, within the bounds.
    """

    def __init__(self, n: int, bounds: tuple[float, float], start: float) -> None:
        super().__init__()
        self.low, self.span = math.log(bounds[0]), math.log(bounds[1] / bounds[0])
        share = math.log(start / bounds[0]) / self.span
        self.theta = nn.Parameter(torch.full((n,), math.log(share / (1.0 - share))))

    def forward(self) -> Tensor:
        """Return the values (n,)."""
        return torch.exp(self.low + self.span * torch.sigmoid(self.theta))


class Unconstrained(nn.Module):
    """Network for any torque of position and velocity, as published; possibly generates power.

    Args:
        n: Number of joints.
        torque_scale: (n,) unit of the outputs [N·m].
        settings: Widths of the hidden layers, and whether the outputs have the unit `torque_scale`.
        seed: Seed of the start weights.
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
        """Return the friction torque (B, n) [N·m]."""
        torque: Tensor = self.network(_inputs(q, qd)) * self.scale
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """Return the torque (K, n) [N·m] of each joint at speeds (K, n) [rad/s].

        For the torque of a joint, q is 0 and all other joints are assumed to be at standstill.
        """
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Return an empty dictionary, because weights have no physical meaning."""
        return {}


def _perceptron(widths: tuple[int, ...], seed: int) -> nn.Sequential:
    """Return tanh layers and a linear output layer; torch's global random state stays unchanged."""
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
