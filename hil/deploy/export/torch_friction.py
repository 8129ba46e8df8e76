"""Friction in PyTorch: every joint's columns side by side, its memory as numbers handed on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from hil.deploy.export.c_columns import GROUPS, LAWS, PEAKS
from hil.deploy.export.program import PlainFriction, terms_of
from hil.deploy.export.torch_constants import hold
from hil.identify.friction.law import FrictionLaw
from hil.identify.friction.motion import MULTIPLES, REFERENCE_C, RIPPLE_FADES_RAD_S
from hil.typing import FloatArray

SLOWEST = 1e-12
"""Below this speed [rad/s] a power of it is 0: no logarithm of 0."""

SENSE_RAD_S = 0.01
"""Width of the smooth sign of ripple."""


Carried = dict[str, Tensor]
"""What is handed on from sample to sample by name, each (B, size)."""


class PlainLaw(nn.Module):
    """Friction without memory.

    Args:
        friction: Of n joints.

    Attributes:
        parts: None; see `MemoryLaw`.
    """

    parts: tuple[tuple[str, int], ...] = ()

    def __init__(self, friction: PlainFriction) -> None:
        super().__init__()
        self.width, self.square = friction.sign_width, friction.power_width**2
        self.bent = bool(np.any(friction.exponent != 1.0))
        hold(
            self,
            coulomb=friction.coulomb,
            viscous=friction.viscous,
            offset=friction.offset,
            bend=0.5 * (friction.exponent - 1.0),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """As `MemoryLaw.forward`."""
        sign = torch.tanh(qd / self.width) if self.width > 0 else torch.sign(qd)
        power = qd * torch.exp(self.bend * torch.log(qd * qd + self.square)) if self.bent else qd
        return self.coulomb * sign + self.viscous * power + self.offset, {}


class MemoryLaw(nn.Module):
    """Friction, ripple and drive of a law whose Dahl states are carried from sample to sample.

    Args:
        law: Of n joints.

    Attributes:
        parts: Name and size of what it carries; zeros are the start.
    """

    def __init__(self, law: FrictionLaw) -> None:
        super().__init__()
        joints = terms_of(law)
        self.n = n = len(joints)
        offset, self.columns = np.zeros(n), dict[str, FloatArray]()
        for j, terms in enumerate(joints):
            for name, weights in terms.items():
                for column, weight in zip(GROUPS[name], weights, strict=True):
                    into = (
                        offset if column == "1.0" else self.columns.setdefault(column, np.zeros(n))
                    )
                    into[j] += weight
        self.columns = {name: w for name, w in self.columns.items() if np.any(w)} or {
            "v": offset * 0
        }
        words = {word for column in self.columns for word in _factors(column)}
        self.multiples = tuple(k for k in MULTIPLES if {f"z{k:g}", f"fabs(z{k:g})"} & words)
        self.warms = "warmth" in words
        states = (("friction", len(self.multiples) * n), ("last", n))
        warmth = (("celsius", n),)
        self.parts = states * bool(self.multiples) + warmth * self.warms
        usual = np.full(n, REFERENCE_C) if law.celsius is None else law.celsius
        hold(
            self,
            offset=offset,
            weights=np.array(list(self.columns.values())),
            shortness=-1.0 / np.outer(self.multiples or [1.0], law.shapes.length),
            stribeck=law.shapes.stribeck,
            power=law.shapes.power,
            turns=np.nan_to_num(law.shapes.turns),
            warmth=np.nan_to_num(usual - REFERENCE_C),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Torque (B, n) [N·m], and what is carried on.

        Args:
            q: (B, n) [rad].
            qd: (B, n) [rad/s].
            gears: (B, n) torque that the gears transmit [N·m].
            begun: (B, 1) whether there was a sample before; None where nothing is carried.
            carried: What `parts` names. `celsius` (B, n) is how much warmer joints are than the
                training was [K].
        """
        after = dict(carried)
        known = {"v": qd.reshape(-1, 1, self.n), "tau": gears.reshape(-1, 1, self.n)}
        if self.multiples:
            way = torch.where(begun, q - carried["last"], torch.zeros_like(q))
            z = self._advanced(carried["friction"], way, qd)
            after |= {"friction": z.reshape(-1, len(self.multiples) * self.n), "last": q}
            names = [f"z{k:g}" for k in self.multiples]
            known |= dict(zip(names, z.split(1, dim=1), strict=True))
        if self.warms:
            known["warmth"] = (self.warmth + carried["celsius"]).reshape(-1, 1, self.n)
        shapes = _Shapes(self, q.reshape(-1, 1, self.n), known)
        columns = torch.cat([_product(shapes, column) for column in self.columns], dim=1)
        return (columns * self.weights).sum(dim=1) + self.offset, after

    def _advanced(self, states: Tensor, way: Tensor, qd: Tensor) -> Tensor:
        """(B, M, n) Dahl's states one step on: only what goes with the velocity counts as way."""
        gone = torch.where(way * qd > 0.0, way, torch.zeros_like(way)).reshape(-1, 1, self.n)
        toward = torch.sign(gone)
        before = states.reshape(-1, len(self.multiples), self.n)
        return toward + (before - toward) * torch.exp(torch.abs(gone) * self.shortness)


class _Shapes:
    """What columns are products of, each (B, 1, n) and computed once."""

    def __init__(self, law: MemoryLaw, q: Tensor, known: dict[str, Tensor]) -> None:
        self._law, self._q, self._known = law, q, known

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._known:
            self._known[name] = self._made(name)
        return self._known[name]

    def _made(self, name: str) -> Tensor:
        law, v = self._law, self["v"]
        simple: dict[str, Callable[[], Tensor]] = {
            "speed": lambda: torch.abs(v),
            "load": lambda: torch.abs(self["tau"]),
            "slow": lambda: torch.exp(self["speed"] * (-1.0 / RIPPLE_FADES_RAD_S)),
            "sense": lambda: torch.tanh(v / SENSE_RAD_S),
            "slog": lambda: torch.log(torch.clamp(self["speed"], min=SLOWEST)),
            "toward": lambda: torch.where(
                self["speed"] > SLOWEST, torch.sign(v), torch.zeros_like(v)
            ),
            "law_p": lambda: self["toward"] * torch.exp(law.power * self["slog"]),
        }
        if name in simple:
            return simple[name]()
        if name in PEAKS:
            return torch.exp(self["speed"] / (-PEAKS[name] * law.stribeck))
        if name in LAWS:
            return self["toward"] * torch.exp(LAWS[name] * self["slog"])
        if name.startswith("fabs("):
            return torch.abs(self[name[5:-1]])
        wave, order = name.rstrip("0123456789"), float(name.lstrip("jsinco"))
        angle = self._q * order if wave.startswith("j") else self._q * (order * law.turns)
        return torch.sin(angle) if wave.endswith("sin") else torch.cos(angle)


def _product(shapes: _Shapes, column: str) -> Tensor:
    first, *others = _factors(column)
    found = shapes[first]
    for name in others:
        found = found * shapes[name]
    return found


def _factors(column: str) -> list[str]:
    """Columns are products; the table of the C export has them as `a * b * c`."""
    return column.split(" * ")
