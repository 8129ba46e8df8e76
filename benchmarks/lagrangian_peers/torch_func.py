"""The same torque by torch.func: M, V and T as functions of one row, derivatives by transforms."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from torch import Tensor
from torch.func import grad, hessian, jacfwd, jvp, vmap

from hil.networks.lagrangian import LagrangianNetwork

Torque = Callable[[Tensor, Tensor, Tensor], Tensor]


def by_jvp(net: LagrangianNetwork) -> Torque:
    """d/dt(M q̇) by one tangent through M(q)·v, ∂(T − V)/∂q by one gradient."""

    def lagrangian(q: Tensor, qd: Tensor) -> Tensor:
        mass, potential = _energies(net, q)
        return 0.5 * qd @ mass @ qd - potential

    def torque(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        rise = jvp(lambda x, v: net.mass(x[None])[0] @ v, (q, qd), (qd, qdd))[1]
        found: Tensor = rise - grad(lagrangian)(q, qd)
        return found

    return _over_rows(torque)


def by_hessian(net: LagrangianNetwork) -> Torque:
    """With all second derivatives of T − V, as DeLaN's version for JAX has it."""

    def lagrangian(q: Tensor, qd: Tensor) -> Tensor:
        mass, potential = _energies(net, q)
        return 0.5 * qd @ mass @ qd - potential

    def torque(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        inertia = hessian(lagrangian, argnums=1)(q, qd) @ qdd
        stirred = jacfwd(grad(lagrangian, argnums=1))(q, qd) @ qd
        found: Tensor = inertia + stirred - grad(lagrangian)(q, qd)
        return found

    return _over_rows(torque)


def _energies(net: LagrangianNetwork, q: Tensor) -> tuple[Tensor, Tensor]:
    """M(q) (n, n) and V(q) of one row (n,), from one pass through the layers."""
    raw = net.trunk(q[None])
    return net.factor.mass(net.factor(raw))[0], net.gravity_unit[0] * raw[0, -1]


def _over_rows(torque: Torque) -> Torque:
    mapped: Torque = vmap(torque)

    def quiet(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        with warnings.catch_warnings():  # torch.func.jvp warns of torch.jit, which it uses itself
            warnings.simplefilter("ignore", DeprecationWarning)
            return mapped(q, qd, qdd)

    return quiet
