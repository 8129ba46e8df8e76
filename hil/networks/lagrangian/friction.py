"""Joint friction as a part of a network: Coulomb–viscous (eq. 3) and Stribeck (eq. 15–18).

Their few parameters are trained together with the weights of the Lagrangian network beside them.
Friction of both kinds has the sign of `direction`: what the caller hands over decides whether it
is memoryless (a smooth sign of the velocity) or has a hysteresis (Dahl's state).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.estimators import choice
from hil.networks.lagrangian.dissipative import Dissipative, NoFriction, Unconstrained
from hil.networks.lagrangian.friction_settings import FRICTIONS, FrictionKind, FrictionSettings
from hil.networks.lagrangian.intrinsic import Between, Free, NotNegative

LEAST_SPEED = 1e-6
"""Slower than this [rad/s] counts as this: d|v|^α/dα = |v|^α·ln|v| is no number at rest."""

LEAST_STRIBECK_SPEED = 1e-3
"""v_s of free parameters comes no nearer to 0 than this [rad/s]."""

LARGEST_EXPONENT = 20.0
"""e to this is 5e8: larger powers than that count as that, in single precision too."""


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


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    """base^exponent of a positive base, with finite gradients whatever the exponent is."""
    return torch.exp((exponent * torch.log(base)).clamp_max(LARGEST_EXPONENT))


def _units(n: int, torque_scale: FloatArray, settings: FrictionSettings) -> FloatArray:
    return settings.unit * np.asarray(torque_scale) if settings.scaled else np.ones(n)


def _coefficient(units: FloatArray, settings: FrictionSettings) -> nn.Module:
    kind = NotNegative if settings.bounded else Free
    return kind(units, 1.0 if settings.scaled else settings.start)


def _shape(
    n: int, settings: FrictionSettings, bounds: tuple[float, float], start: float
) -> nn.Module:
    return Between(n, bounds, start) if settings.bounded else Free(np.ones(n), start)


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
