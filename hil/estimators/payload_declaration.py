"""Whether declared loads are those that recordings show, and what about them is wrong.

An identified load differs from the one mounted by its own error, by what the model of the arm has
wrong all the time, and by the drive gains: a joint whose gain is really larger by a share makes
every load too light by part of that share (`PayloadEstimate.by_gain`). Gains are the same for all
loads of a run, so other loads tell them: each load is judged with the gains that the trusted ones
beside it leave probable. Trusted is the largest set of loads that agree with one another.

A quantity contradicts its declaration when it is further off than a limit that correct ones of a
load all keep, except with the probability `false_alarm`: Student's t by the estimate's blocks of
time, gains of `GAIN_SHARE`, and a `Floor` for other errors of the model.

A load that contradicts its declaration does so by a `Finding` with a name: its mass, its centre, a
tool mounted the wrong way round, its inertia, or an inertia that no body has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics import GAIN_SHARE
from hil.estimators.distributions import normal_quantile, student_quantile
from hil.estimators.payload import PayloadEstimate, true_values

FALSE_ALARM = 0.002
"""How often a correct declaration may be called wrong."""

TELLING = 4
"""Values that gains are judged by: mass and centre. Inertias are too weakly known for that."""

MOST = 8
"""Loads among which every set is tried; of more, those beyond are trusted last."""


@dataclass(frozen=True, slots=True)
class Floor:
    """Standard deviations of what a model has wrong besides gains, whatever is recorded.

    The defaults are about twice what the embedded mock's UR5 leaves (seeds 1 to 9, 1, 3 and 5 kg,
    `rigid-hysteresis` and `rigid-wls`), once other loads have told the gains.

    Attributes:
        mass_kg: Of the mass of light loads.
        mass_share: Of the mass of heavy ones: the larger of both counts.
        com_m: Of each coordinate of the centre of mass.
        inertia_kgm2: Of each inertia.
    """

    mass_kg: float = 0.01
    mass_share: float = 0.01
    com_m: float = 0.002
    inertia_kgm2: float = 0.002

    def deviations(self, mass: float) -> FloatArray:
        """(10,) in the order of `PayloadEstimate.values`."""
        heavy = max(self.mass_kg, self.mass_share * mass)
        return np.array([heavy, *3 * [self.com_m], *6 * [self.inertia_kgm2]])


@dataclass(frozen=True, slots=True, eq=False)
class Declaration:
    """A declared load beside what was identified.

    Attributes:
        declared: As somebody wrote it.
        found: (10,) identified, in the order of `PayloadEstimate.values`, corrected by the gains
            that the trusted loads tell.
        limit: (10,) how far off each may be.
        findings: What contradicts it; empty when nothing does.
        trusted: Whether the gains of other loads are judged by it.
        mount_observable: Whether a tool turned half about the flange's axis would show.
        gains: (n,) shares by which the drive gains are above the model's, as the trusted loads
            beside this one tell; zeros without any.
    """

    declared: Payload
    found: FloatArray
    limit: FloatArray
    findings: tuple[Finding, ...]
    trusted: bool
    mount_observable: bool
    gains: FloatArray

    @property
    def agrees(self) -> bool:
        """Whether nothing contradicts it."""
        return not self.findings


def check_declarations(
    declared: Sequence[Payload],
    estimates: Sequence[PayloadEstimate],
    *,
    false_alarm: float = FALSE_ALARM,
    floor: Floor | None = None,
) -> tuple[Declaration, ...]:
    """Every declared load of a run against the identified one.

    Args:
        declared: Loads as declared.
        estimates: One each, all by the same model of the same arm.
        false_alarm: Probability with which a correct declaration may be called wrong.
        floor: Errors of the model.
    """
    cases = [
        _Case(*pair, false_alarm, floor or Floor())
        for pair in zip(declared, estimates, strict=True)
    ]
    trusted = _trusted(cases)
    return tuple(case.judged(_others(cases, trusted, i), i in trusted) for i, case in _all(cases))


class _Case:
    """One load; `off` (10,) is by how much the estimate is above the declaration."""

    def __init__(
        self, declared: Payload, estimate: PayloadEstimate, false_alarm: float, floor: Floor
    ) -> None:
        self.declared = declared
        self.by_gain = estimate.by_gain * (estimate.unit == "A")  # torques have no gains
        self.values = estimate.values
        self.off = estimate.values - (0.0 if declared.is_empty else true_values(declared))
        tail = false_alarm / (2 * len(self.values))
        self.reach = float(-normal_quantile(tail))
        # Few blocks of time know their own scatter badly: as much wider as Student's t asks.
        wider = -student_quantile(tail, estimate.degrees) / self.reach
        spread = estimate.covariance * np.outer(wider, wider)
        self.covariance = spread + np.diag(floor.deviations(estimate.values[0]) ** 2)

    def judged(self, others: Sequence[_Case], trusted: bool) -> Declaration:
        """With the gains that other loads leave probable."""
        gains, spread = _gains(others, self.by_gain.shape[1])
        found = self.values + self.by_gain @ gains
        covariance = self.covariance + self.by_gain @ spread @ self.by_gain.T
        limit = self.reach * np.sqrt(np.diag(covariance))
        return Declaration(
            self.declared, found, limit, tuple(_findings(self.declared, found, limit)), trusted,
            mount_observable(self.declared, limit), gains,
        )  # fmt: skip

    def agrees(self, others: Sequence[_Case]) -> bool:
        """Whether the gains that other loads tell leave nothing to be found."""
        return self.judged(others, True).agrees


def _gains(cases: Sequence[_Case], n: int) -> tuple[FloatArray, FloatArray]:
    """(n,) shares by which gains are larger than the model's, and their covariance (n, n)."""
    information, told = np.eye(n) / GAIN_SHARE**2, np.zeros(n)
    for case in cases:
        S = case.by_gain[:TELLING]
        weighted = np.linalg.solve(case.covariance[:TELLING, :TELLING], S)
        information += S.T @ weighted
        told -= weighted.T @ case.off[:TELLING]
    spread = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return spread @ told, spread


def _trusted(cases: Sequence[_Case]) -> frozenset[int]:
    """Numbers of the largest set of loads that agree; of several, of the one that agrees best."""
    telling = [i for i, case in _all(cases) if not case.declared.is_empty][:MOST]
    for size in range(len(telling), 0, -1):
        sets = [
            chosen
            for chosen in map(frozenset, combinations(telling, size))
            if all(cases[i].agrees(_others(cases, chosen, i)) for i in chosen)
        ]
        if sets:
            return min(sets, key=lambda chosen: _misfit([cases[i] for i in sorted(chosen)]))
    return frozenset()


def _misfit(cases: Sequence[_Case]) -> float:
    """χ² of a set with its own best gains, those gains included."""
    gains, _ = _gains(cases, cases[0].by_gain.shape[1])
    total = float(np.sum((gains / GAIN_SHARE) ** 2))
    for case in cases:
        left = (case.off + case.by_gain @ gains)[:TELLING]
        total += float(left @ np.linalg.solve(case.covariance[:TELLING, :TELLING], left))
    return total


def _others(cases: Sequence[_Case], chosen: frozenset[int], but: int) -> list[_Case]:
    return [cases[i] for i in sorted(chosen) if i != but]


def _all(cases: Sequence[_Case]) -> list[tuple[int, _Case]]:
    return list(enumerate(cases))


TURNED_RAD = np.radians(45.0)
"""A centre that is turned about the flange's axis by as much is a tool mounted the wrong way."""

SLACK = 1e-9
"""Share of an inertia by which rounding may take it out of what bodies can have."""

Kind = Literal["mass", "centre", "mount", "inertia", "no body"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One contradiction.

    Attributes:
        kind: What is wrong: the mass, the centre of mass, the angle of the mount, the inertia, or
            that no body has such an inertia.
        text: The same with figures, for people.
    """

    kind: Kind
    text: str


def _findings(declared: Payload, found: FloatArray, limit: FloatArray) -> Iterator[Finding]:
    """What contradicts a declaration.

    Args:
        declared: The load.
        found: (10,) identified, in the order of `PayloadEstimate.values`.
        limit: (10,) how far off each may be.
    """
    more = found[0] - declared.mass
    if abs(more) > limit[0]:
        told = f"{abs(more):.2f} kg {'heavier' if more > 0 else 'lighter'} than declared"
        yield Finding("mass", f"{told} (±{limit[0]:.2f} kg)")
    if declared.is_empty:
        return  # the centre of nothing is nowhere
    turn = 0.0
    com, reach = np.array(declared.com), limit[1:4]
    if np.any(np.abs(found[1:4] - com) > reach):
        turn = _turn(com, found[1:4], reach)
        yield _centre(com, found[1:4], turn)
    yield from _inertia(_matrix(np.array(declared.inertia)), turn, found[4:], limit[4:])


def mount_observable(declared: Payload, limit: FloatArray) -> bool:
    """Whether half a turn about the flange's axis would move the centre by more than its limit."""
    x, y, _ = (abs(value) for value in declared.com)
    return bool(not declared.is_empty and (2 * x > limit[1] or 2 * y > limit[2]))


def _centre(com: FloatArray, found: FloatArray, turn: float) -> Finding:
    distance = 1e3 * float(np.linalg.norm(found - com))
    if turn:
        return Finding("mount", f"turned by {np.degrees(turn):.0f}° about the flange's axis")
    by = ", ".join(f"{1e3 * value:+.0f}" for value in found - com)
    return Finding("centre", f"centre of mass {distance:.0f} mm off: by ({by}) mm")


def _turn(com: FloatArray, found: FloatArray, reach: FloatArray) -> float:
    """Angle about z that explains where the centre was found [rad]; 0 when none does."""
    angle = np.arctan2(found[1], found[0]) - np.arctan2(com[1], com[0])
    angle = float((angle + np.pi) % (2 * np.pi) - np.pi)
    explained = np.all(np.abs(_about_z(angle) @ com - found) <= reach)
    return angle if explained and abs(angle) >= TURNED_RAD else 0.0


def _inertia(
    declared: FloatArray, turn: float, found: FloatArray, limit: FloatArray
) -> Iterator[Finding]:
    if not np.any(declared):
        return  # nobody declared one
    half = 0.5 * float(np.trace(declared))
    if np.linalg.eigvalsh(half * np.eye(3) - declared)[0] < -SLACK * max(abs(half), 1e-300):
        yield Finding("no body", "no body has the inertia declared")
        return
    R = _about_z(turn)
    turned = R @ declared @ R.T
    off = found - turned[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    worst = int(np.argmax(np.abs(off) / limit))
    if abs(off[worst]) > limit[worst]:
        name = ("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")[worst]
        told = f"{name} {abs(off[worst]):.3g} kg·m² {'more' if off[worst] > 0 else 'less'}"
        yield Finding("inertia", f"{told} than declared (±{limit[worst]:.2g} kg·m²)")


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _matrix(six: FloatArray) -> FloatArray:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
