"""Check of declared payloads against the payloads identified from recordings.

An identified payload differs from the mounted payload by its own error, by constant errors of the
arm model, and by errors of the drive gains. If the true gain of a joint exceeds the gain in the
model, every payload is identified as too light by part of that share (`PayloadEstimate.by_gain`).
The gains are the same for all payloads of a run, so that the other payloads of the run provide
information on them. Each payload is checked with the gains that the trusted payloads of the same
run make probable. The trusted payloads are the largest set of payloads whose declarations agree
with one another.

An identified quantity contradicts its declaration if it differs from the declared value by more
than a limit. The probability that any identified quantity of a correctly declared payload exceeds
its limit is at most `false_alarm`. The limit of a deviation follows from Student's t distribution
over the time blocks of the estimate, from drive-gain errors of `GAIN_SHARE`, and from a `Floor` for
other errors of the model.

Each contradiction is a `Finding` with a kind: the mass, the centre of mass, a rotated mounting, the
inertia, or a physically inconsistent inertia.
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
"""Probability that a correctly declared payload is reported as wrong."""

TELLING = 4
"""Number of payload values used to estimate the drive gains: mass and centre of mass.

The inertias are not used for the drive gains, because their errors are too large.
"""

MOST = 8
"""Largest number of payloads for which every subset is tested for agreement.

Payloads beyond this number are never used as trusted payloads.
"""


@dataclass(frozen=True, slots=True)
class Floor:
    """Standard deviations of the model errors apart from drive gains, independent of the recording.

    The default standard deviations are about twice the errors on the UR5 of the embedded mock
    (seeds 1 to 9, 1, 3 and 5 kg, `rigid-hysteresis` and `rigid-wls`), after other payloads have
    determined the drive gains.

    Attributes:
        mass_kg: Error of the mass of a light payload [kg].
        mass_share: Error of the mass of a heavy payload, as a share; the larger of `mass_kg` and
            this error applies.
        com_m: Error of each coordinate of the centre of mass [m].
        inertia_kgm2: Error of each component of the inertia [kg·m²].
    """

    mass_kg: float = 0.01
    mass_share: float = 0.01
    com_m: float = 0.002
    inertia_kgm2: float = 0.002

    def deviations(self, mass: float) -> FloatArray:
        """Return (10,) the standard deviations of the errors of `PayloadEstimate.values`."""
        heavy = max(self.mass_kg, self.mass_share * mass)
        return np.array([heavy, *3 * [self.com_m], *6 * [self.inertia_kgm2]])


@dataclass(frozen=True, slots=True, eq=False)
class Declaration:
    """Result of the check of one declared payload.

    Attributes:
        declared: Payload as declared for the run.
        found: (10,) identified values in the order of `PayloadEstimate.values`, corrected for the
            drive gains that the trusted payloads determine.
        limit: (10,) largest accepted difference of each value.
        findings: List of contradictions to the declaration; empty if there are none.
        trusted: Whether this payload is used to determine the drive gains for other payloads.
        mount_observable: Whether a mounting rotated by 180° about the flange axis would be
            detected.
        gains: (n,) shares by which the drive gains exceed the gains in the model, determined from
            the other trusted payloads; zeros without such payloads.
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
        """Whether the payload does not contradict its declaration."""
        return not self.findings


def check_declarations(
    declared: Sequence[Payload],
    estimates: Sequence[PayloadEstimate],
    *,
    false_alarm: float = FALSE_ALARM,
    floor: Floor | None = None,
) -> tuple[Declaration, ...]:
    """Return the check of every declared payload of a run against the identified payload.

    Args:
        declared: Payloads as declared for the run.
        estimates: One estimate per declared payload, all from the same model of the same arm.
        false_alarm: False-alarm rate of a correctly declared payload.
        floor: Standard deviations of the model errors apart from drive gains.
    """
    cases = [
        _Case(*pair, false_alarm, floor or Floor())
        for pair in zip(declared, estimates, strict=True)
    ]
    trusted = _trusted(cases)
    return tuple(case.judged(_others(cases, trusted, i), i in trusted) for i, case in _all(cases))


class _Case:
    """Declared and identified payload; `off` (10,) is the identified minus the declared one."""

    def __init__(
        self, declared: Payload, estimate: PayloadEstimate, false_alarm: float, floor: Floor
    ) -> None:
        self.declared = declared
        self.by_gain = estimate.by_gain * (estimate.unit == "A")  # torque data have no drive gains
        self.values = estimate.values
        self.off = estimate.values - (0.0 if declared.is_empty else true_values(declared))
        tail = false_alarm / (2 * len(self.values))
        self.reach = float(-normal_quantile(tail))
        # Few blocks of time estimate their scatter badly, so Student's t widens the limits.
        wider = -student_quantile(tail, estimate.degrees) / self.reach
        spread = estimate.covariance * np.outer(wider, wider)
        self.covariance = spread + np.diag(floor.deviations(estimate.values[0]) ** 2)

    def judged(self, others: Sequence[_Case], trusted: bool) -> Declaration:
        """Return the payload check with the drive gains that other payloads make probable."""
        gains, spread = _gains(others, self.by_gain.shape[1])
        found = self.values + self.by_gain @ gains
        covariance = self.covariance + self.by_gain @ spread @ self.by_gain.T
        limit = self.reach * np.sqrt(np.diag(covariance))
        return Declaration(
            self.declared, found, limit, tuple(_findings(self.declared, found, limit)), trusted,
            mount_observable(self.declared, limit), gains,
        )  # fmt: skip

    def agrees(self, others: Sequence[_Case]) -> bool:
        """Return whether a payload has no finding if the gains come from other payloads."""
        return self.judged(others, True).agrees


def _gains(cases: Sequence[_Case], n: int) -> tuple[FloatArray, FloatArray]:
    """Return (n,) the relative drive-gain errors of the model, and their covariance (n, n).

    A positive error means that the true gain is above the gain in the model.
    """
    information, score = np.eye(n) / GAIN_SHARE**2, np.zeros(n)
    for case in cases:
        S = case.by_gain[:TELLING]
        weighted = np.linalg.solve(case.covariance[:TELLING, :TELLING], S)
        information += S.T @ weighted
        score -= weighted.T @ case.off[:TELLING]
    spread = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return spread @ score, spread


def _trusted(cases: Sequence[_Case]) -> frozenset[int]:
    """Return the indices of the largest set of payloads that agree with one another.

    If several sets have the same size, the set with the smallest misfit is returned.
    """
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
    """Return χ² of a set of payloads at its best drive gains, with the prior of the gains."""
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
"""Minimum rotation about the flange axis that counts as a wrongly rotated mounting [rad]."""

SLACK = 1e-9
"""Tolerance for rounding in the physical consistency of an inertia, as a share of the inertia."""

Kind = Literal["mass", "centre", "mount", "inertia", "no body"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One contradiction between a declared and an identified payload.

    Attributes:
        kind: Name of the contradicting quantity: the mass, the centre of mass, the mounting angle,
            the inertia, or a physically inconsistent inertia.
        text: Description of the contradiction with numbers, for the user.
    """

    kind: Kind
    text: str


def _findings(declared: Payload, found: FloatArray, limit: FloatArray) -> Iterator[Finding]:
    """Yield the contradictions between an identified payload and its declaration.

    Args:
        declared: Payload as declared in the spec.
        found: (10,) identified values, in the order of `PayloadEstimate.values`.
        limit: (10,) largest accepted difference between identified and declared values.
    """
    more = found[0] - declared.mass
    if abs(more) > limit[0]:
        text = f"{abs(more):.2f} kg {'heavier' if more > 0 else 'lighter'} than declared"
        yield Finding("mass", f"{text} (±{limit[0]:.2f} kg)")
    if declared.is_empty:
        return  # the centre of mass of an empty payload is undefined
    turn = 0.0
    com, reach = np.array(declared.com), limit[1:4]
    if np.any(np.abs(found[1:4] - com) > reach):
        turn = _turn(com, found[1:4], reach)
        yield _centre(com, found[1:4], turn)
    yield from _inertia(_matrix(np.array(declared.inertia)), turn, found[4:], limit[4:])


def mount_observable(declared: Payload, limit: FloatArray) -> bool:
    """Return whether a 180° rotation about the flange axis moves the centre of mass too far."""
    x, y, _ = (abs(value) for value in declared.com)
    return bool(not declared.is_empty and (2 * x > limit[1] or 2 * y > limit[2]))


def _centre(com: FloatArray, found: FloatArray, turn: float) -> Finding:
    distance = 1e3 * float(np.linalg.norm(found - com))
    if turn:
        return Finding("mount", f"turned by {np.degrees(turn):.0f}° about the flange axis")
    by = ", ".join(f"{1e3 * value:+.0f}" for value in found - com)
    return Finding("centre", f"centre of mass {distance:.0f} mm off: by ({by}) mm")


def _turn(com: FloatArray, found: FloatArray, reach: FloatArray) -> float:
    """Return the rotation about z that explains the identified centre of mass [rad], or 0."""
    angle = np.arctan2(found[1], found[0]) - np.arctan2(com[1], com[0])
    angle = float((angle + np.pi) % (2 * np.pi) - np.pi)
    explained = np.all(np.abs(_about_z(angle) @ com - found) <= reach)
    return angle if explained and abs(angle) >= TURNED_RAD else 0.0


def _inertia(
    declared: FloatArray, turn: float, found: FloatArray, limit: FloatArray
) -> Iterator[Finding]:
    if not np.any(declared):
        return  # no inertia was declared
    half = 0.5 * float(np.trace(declared))
    if np.linalg.eigvalsh(half * np.eye(3) - declared)[0] < -SLACK * max(abs(half), 1e-300):
        yield Finding("no body", "the declared inertia is not physically consistent")
        return
    R = _about_z(turn)
    turned = R @ declared @ R.T
    off = found - turned[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    worst = int(np.argmax(np.abs(off) / limit))
    if abs(off[worst]) > limit[worst]:
        name = ("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")[worst]
        text = f"{name} {abs(off[worst]):.3g} kg·m² {'more' if off[worst] > 0 else 'less'}"
        yield Finding("inertia", f"{text} than declared (±{limit[worst]:.2g} kg·m²)")


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _matrix(six: FloatArray) -> FloatArray:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
