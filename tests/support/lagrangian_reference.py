"""A Lagrangian network written down anew: M and V as plain functions, derivatives by torch.func."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from torch.func import grad, hessian, jacfwd, vmap  # noqa: E402
from torch.nn import functional  # noqa: E402

from hil.networks.lagrangian import LagrangianNetwork  # noqa: E402
from hil.networks.lagrangian_settings import NetworkSettings  # noqa: E402

SCALE = (25.0, 36.0, 16.0, 4.0, 2.25, 6.25)
"""Whose roots single precision holds exactly: networks begin in it."""
SETTINGS = {
    "ours": NetworkSettings(hidden=(32, 24)),
    "literal": NetworkSettings.literal().model_copy(update={"hidden": (32, 24)}),
    "tanh-raw-mass": NetworkSettings(
        hidden=(16,), activation="tanh", features="raw", epsilon_of="mass"
    ),
    "silu-head": NetworkSettings(hidden=(16, 16, 16), activation="silu", gravity="head"),
}
ACTIVATIONS = {
    "softplus": lambda x: torch.logaddexp(x, torch.zeros_like(x)),
    "relu": lambda x: x.clamp(min=0.0),
    "tanh": torch.tanh,
    "silu": functional.silu,
}


def network(settings, n=6, seed=3):
    """In float64, with numbers in the biases too."""
    net = LagrangianNetwork(n, settings, SCALE[:n], seed).double()
    with torch.no_grad():
        for name, values in net.named_parameters():
            if name.endswith("bias"):
                values += 0.1 * torch.randn(
                    values.shape, dtype=values.dtype, generator=torch.Generator().manual_seed(1)
                )
    return net


def motion(rows, n=6, seed=0):
    """q, qd, qdd (rows, n) in float64."""
    random = np.random.default_rng(seed)
    return tuple(torch.as_tensor(random.uniform(-s, s, (rows, n))) for s in (np.pi, 2.0, 5.0))


class Reference:
    """Mass matrix and potential of one q (n,), from a network's weights."""

    def __init__(self, net, settings, n=6):
        self.settings, self.n = settings, n
        state = net.state_dict()
        names = [f"trunk.layers.{i}" for i in range(len(settings.hidden))] + ["trunk.last"]
        self.weights = [(state[f"{name}.weight"], state[f"{name}.bias"]) for name in names]
        unit = SCALE[:n] if settings.scaled else (1.0,) * n
        self.unit = torch.tensor(unit, dtype=torch.float64)

    def raw(self, q):
        """Outputs before they mean anything."""
        x = torch.cat([torch.cos(q), torch.sin(q)]) if self.settings.features == "sincos" else q
        for W, b in self.weights[:-1]:
            x = ACTIVATIONS[self.settings.activation](W @ x + b)
        W, b = self.weights[-1]
        return W @ x + b

    def mass(self, q):
        """M(q) (n, n), its factor filled entry by entry."""
        n, raw, s = self.n, self.raw(q), self.settings
        diagonal = ACTIVATIONS[s.diagonal](raw[:n])
        L = torch.diag(diagonal + (s.epsilon if s.epsilon_of == "factor" else 0.0))
        place = n
        for row in range(n):
            for column in range(row):
                corner = torch.zeros(n, n, dtype=q.dtype)
                corner[row, column] = 1.0
                L = L + raw[place] * corner
                place += 1
        L = torch.diag(torch.sqrt(self.unit)) @ L
        added = s.epsilon if s.epsilon_of == "mass" else 0.0
        return L @ L.T + added * torch.eye(n, dtype=q.dtype)

    def gravity(self, q):
        """g(q) (n,)."""
        entries = self.n * (self.n + 1) // 2
        if self.settings.gravity == "head":
            return self.unit * self.raw(q)[entries:]
        return grad(lambda x: self.unit.max() * self.raw(x)[entries])(q)

    def torque(self, q, qd, qdd):
        """Euler–Lagrange with whole second derivatives of T."""

        def kinetic(x, v):
            return 0.5 * v @ self.mass(x) @ v

        by_speed_and_q = jacfwd(grad(kinetic, argnums=1), argnums=0)(q, qd)
        M = hessian(kinetic, argnums=1)(q, qd)
        return M @ qdd + by_speed_and_q @ qd - grad(kinetic)(q, qd) + self.gravity(q)

    def coriolis(self, q, qd):
        """By Christoffel's symbols of the first kind."""
        D = jacfwd(self.mass)(q)
        symbols = 0.5 * (D + D.permute(0, 2, 1) - D.permute(2, 1, 0))
        return torch.einsum("ijk,j,k->i", symbols, qd, qd)

    def rows(self, what, *motion):
        """One of the above for rows of a motion."""
        return vmap(getattr(self, what))(*motion)
