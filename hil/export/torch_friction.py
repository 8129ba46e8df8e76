"""Friction in PyTorch: every joint's columns side by side, its memory as numbers handed on."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.estimators import MULTIPLES, REFERENCE_C, RIPPLE_FADES_RAD_S, FrictionLaw
from hil.export.c_columns import GROUPS, LAWS, PEAKS
from hil.export.program import PlainFriction, terms_of
from hil.export.torch_constants import hold

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
        self.hard = friction.sign_width == 0
        self.bent = bool(np.any(friction.exponent != 1.0))
        hold(
            self,
            coulomb=friction.coulomb,
            viscous=friction.viscous,
            offset=friction.offset,
            width=np.array([friction.sign_width]),
            bend=0.5 * (friction.exponent - 1.0),
            square=np.array([friction.power_width**2]),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """As `MemoryLaw.forward`."""
        sign = torch.sign(qd) if self.hard else torch.tanh(qd / self.width)
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
        offset, weights = _weights(law)
        self.n = n = len(offset)
        # Columns of as many factors behind each other, so that they are multiplied together.
        self.columns = sorted((column.split(" * ") for column in weights), key=len)
        words = {word for column in self.columns for word in column}
        words |= {word[5:-1] for word in words if word.startswith("fabs(")}
        self.multiples = tuple(k for k in MULTIPLES if f"z{k:g}" in words)
        self.warms, self.slows, self.senses = (w in words for w in ("warmth", "slow", "sense"))
        self.peaks = [name for name in PEAKS if name in words]
        self.laws = [name for name in ("law_p", *LAWS) if name in words]
        waves = {word for word in words if word.lstrip("j").startswith(("sin", "cos"))}
        self.waves = sorted({word.replace("sin", "").replace("cos", "") for word in waves})
        states = (("friction", len(self.multiples) * n), ("last", n))
        self.parts = states * bool(self.multiples) + (("warmer_k", n),) * self.warms
        hold(
            self,
            offset=offset,
            weights=np.array([weights[" * ".join(column)] for column in self.columns]),
            **self._shapes(law),
        )

    def _shapes(self, law: FrictionLaw) -> dict[str, FloatArray]:
        shapes, one = law.shapes, np.ones(self.n)
        usual = REFERENCE_C * one if law.celsius is None else law.celsius
        powers = {"law_p": shapes.power, **{name: power * one for name, power in LAWS.items()}}
        turns = np.nan_to_num(shapes.turns)
        return {
            "shortness": -1.0 / np.outer(self.multiples or (1.0,), shapes.length),
            "peak_rates": np.array([-1.0 / (PEAKS[name] * shapes.stribeck) for name in self.peaks]),
            "powers": np.array([powers[name] for name in self.laws]),
            "orders": np.array(
                [float(k.lstrip("j")) * (one if k.startswith("j") else turns) for k in self.waves]
            ),
            "warmth": np.nan_to_num(usual - REFERENCE_C),
            "slow_rate": np.array([-1.0 / RIPPLE_FADES_RAD_S]),
            "sense_rate": np.array([1.0 / SENSE_RAD_S]),
        }

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Torque (B, n) [N·m], and what is carried on.

        Args:
            q: (B, n) [rad].
            qd: (B, n) [rad/s].
            gears: (B, n) torque that the gears transmit [N·m].
            begun: (B, 1) whether there was a sample before; None where nothing is carried.
            carried: What `parts` names. `warmer_k` (B, n) is how much warmer joints are than
                the training was [K].
        """
        after = dict(carried)
        rows = [one.reshape(-1, 1, self.n) for one in (q, qd, gears)]
        known = self._now(*rows)
        if self.multiples:
            way = torch.where(begun, q - carried["last"], 0.0)
            z = self._advanced(carried["friction"], way, qd)
            after |= {"friction": z.reshape(-1, len(self.multiples) * self.n), "last": q}
            states = _split([f"z{k:g}" for k in self.multiples], z)
            known |= states | {f"fabs({name})": torch.abs(state) for name, state in states.items()}
        if self.warms:
            known["warmth"] = (self.warmth + carried["warmer_k"]).reshape(-1, 1, self.n)
        return (self._products(known) * self.weights).sum(dim=1) + self.offset, after

    def _now(self, q: Tensor, v: Tensor, tau: Tensor) -> dict[str, Tensor]:
        """What columns are products of, each (B, 1, n), but for memory and warmth."""
        speed = torch.abs(v)
        known = {"v": v, "speed": speed, "tau": tau, "load": torch.abs(tau)}
        if self.peaks:
            known |= _split(self.peaks, torch.exp(speed * self.peak_rates))
        if self.laws:
            toward = torch.where(speed > SLOWEST, torch.sign(v), 0.0)
            power = torch.exp(torch.log(torch.clamp(speed, min=SLOWEST)) * self.powers)
            known |= _split(self.laws, toward * power)
        if self.waves:
            angle = q * self.orders
            for wave, values in (("sin", torch.sin(angle)), ("cos", torch.cos(angle))):
                names = [f"{'j' * k.startswith('j')}{wave}{k.lstrip('j')}" for k in self.waves]
                known |= _split(names, values)
        if self.slows:
            known["slow"] = torch.exp(speed * self.slow_rate)
        if self.senses:
            known["sense"] = torch.tanh(v * self.sense_rate)
        return known

    def _products(self, known: dict[str, Tensor]) -> Tensor:
        """(B, C, n) columns."""
        found = []
        for _, group in groupby(self.columns, key=len):
            first, *others = (
                torch.cat([known[name] for name in names], dim=1)
                for names in zip(*group, strict=True)
            )
            for factor in others:
                first = first * factor
            found.append(first)
        return torch.cat(found, dim=1)

    def _advanced(self, states: Tensor, way: Tensor, qd: Tensor) -> Tensor:
        """(B, M, n) Dahl's states one step on: only what goes with the velocity counts as way."""
        gone = torch.where(way * qd > 0.0, way, 0.0).reshape(-1, 1, self.n)
        toward = torch.sign(gone)
        before = states.reshape(-1, len(self.multiples), self.n)
        return toward + (before - toward) * torch.exp(torch.abs(gone) * self.shortness)


def _weights(law: FrictionLaw) -> tuple[FloatArray, dict[str, FloatArray]]:
    """(n,) constants, and every other column's coefficient of each joint; at least one column."""
    joints = terms_of(law)
    offset, weights = np.zeros(len(joints)), dict[str, FloatArray]()
    for j, terms in enumerate(joints):
        for name, found in terms.items():
            for column, weight in zip(GROUPS[name], found, strict=True):
                if column == "1.0":
                    offset[j] += weight
                else:
                    weights.setdefault(column, np.zeros(len(joints)))[j] += weight
    used = {column: weight for column, weight in weights.items() if np.any(weight)}
    return offset, used or {"v": np.zeros(len(joints))}


def _split(names: list[str], values: Tensor) -> dict[str, Tensor]:
    """Rows of (B, K, n) by name, each (B, 1, n)."""
    return dict(zip(names, values.split(1, dim=1), strict=True))
