"""Whether a weighed load is the one declared, with figures for people and for the event log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.spec import Weigh
from hil.workflow.scales import Comparison, LoadReading

TELLING = 0.5
"""Share of the difference between two loads that a limit must stay below to tell them apart."""

SURE = 4.0
"""In standard deviations: what is no further off than this may be the weighing's own error."""


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """A comparison and how far off it may be.

    A weighing that is less certain than the tolerances ask for (a short reach, stiff joints) is
    judged by its own certainty. Where there is no declared centre of mass, or the load's is
    another, the mass that counts is the one that takes no notice of where that is.

    Attributes:
        found: The load as weighed.
        tolerance: Of the spec.
        differs_kg: By how much the load differs from what may hang there instead, see `differs`.
        again: Whether it is the first load itself, against what it weighed in an earlier attempt.
    """

    found: Comparison
    tolerance: Weigh
    differs_kg: float
    again: bool = False

    @property
    def weighed_kg(self) -> float:
        """The mass that counts."""
        return self.found.weighed_kg if self._centre_known else self.found.free_kg

    @property
    def deviation_kg(self) -> float:
        """Standard deviation of `weighed_kg`."""
        found = self.found
        return found.deviation_kg if self._centre_known else found.free_deviation_kg

    @property
    def mass_limit_kg(self) -> float:
        """How far off the mass may be."""
        tolerance, found = self.tolerance, self.found
        difference = abs(found.declared.mass - found.first_kg)
        tolerated = tolerance.tolerance_kg + tolerance.tolerance_percent / 100 * difference
        return max(tolerated, SURE * self.deviation_kg)

    @property
    def com_limit_m(self) -> float:
        """How far off the centre of mass may be."""
        sure = SURE * self.found.shift_deviation_m
        return max(self.tolerance.tolerance_com_m, sure if np.isfinite(sure) else 0.0)

    @property
    def mass_passed(self) -> bool:
        """Whether the mass is near enough to what was declared."""
        return abs(self.weighed_kg - self.found.declared.mass) <= self.mass_limit_kg

    @property
    def com_passed(self) -> bool:
        """Whether the centre of mass is near enough to where it was declared to be."""
        return self.found.distance_m <= self.com_limit_m

    @property
    def passed(self) -> bool:
        """Whether the load is the one declared."""
        return self.mass_passed and self.com_passed

    @property
    def conclusive(self) -> bool:
        """Whether the mass of another load would not have passed as well."""
        return self.mass_limit_kg < TELLING * self.differs_kg

    @property
    def figures(self) -> dict[str, Any]:
        """Plain numbers for the event log."""
        found = self.found
        out: dict[str, Any] = {
            "declared_kg": found.declared.mass,
            "weighed_kg": _plain(self.weighed_kg),
            "deviation_kg": _plain(self.deviation_kg),
            "limit_kg": _plain(self.mass_limit_kg),
            "differs_kg": _plain(self.differs_kg),
            "declared_nm": _plain(found.declared_nm),
            "found_nm": _plain(found.found_nm),
        }
        if not found.declared.is_empty:
            out |= {
                "com_m": list(found.declared.com),
                "shift_m": _plain(found.shift_m),
                "shift_deviation_m": _plain(found.shift_deviation_m),
                "shift_limit_m": _plain(self.com_limit_m),
            }
        return out

    def text(self, joint_names: Sequence[str]) -> str:
        """What is wrong, joint by joint."""
        told = self._masses
        if not self.com_passed:
            told += f"; {self._centre()}"
        return "\n".join([told, *_by_joint(self.found, joint_names)])

    @property
    def doubt(self) -> str:
        """Why a load that passed may be another one all the same."""
        apart = f"{self.differs_kg:.2f} kg"
        return f"{self._masses}, which does not tell loads apart that differ by {apart}"

    @property
    def _masses(self) -> str:
        found = self.found
        earlier = " in an earlier attempt" if self.again else ""
        return (
            f"{found.declared.mass:.2f} kg declared, {self.weighed_kg:.2f} ± "
            f"{self.deviation_kg:.2f} kg weighed against the {found.first_kg:.2f} kg of load 0"
            f"{earlier} (limit ± {self.mass_limit_kg:.2f} kg)"
        )

    @property
    def _centre_known(self) -> bool:
        return self.com_passed and not self.found.declared.is_empty

    def _centre(self) -> str:
        found = self.found
        seen = np.array(found.declared.com) + found.shift_m
        return (
            f"centre of mass at {_point(found.declared.com)} m declared, near {_point(seen)} m "
            f"weighed: {1e3 * found.distance_m:.0f} ± {1e3 * found.shift_deviation_m:.0f} mm away "
            f"(limit {1e3 * self.com_limit_m:.0f} mm)"
        )


def differs(masses: Sequence[float], load: int) -> float:
    """By how much [kg] a load differs from the first one, which may have been left on.

    One that weighs the same as the first: from the load of another mass that is nearest.
    """
    own = masses[load]
    others = [abs(own - other) for other in masses if other != own]
    return abs(own - masses[0]) or min(others, default=0.0)


def friction_of(first: LoadReading) -> dict[str, Any]:
    """What the first load's weighing says beside being the first: friction, pose by pose."""
    return {"half_difference_nm": _plain(first.half_difference)}


def _by_joint(found: Comparison, joint_names: Sequence[str]) -> list[str]:
    declared, weighed = (
        [", ".join(f"{round(value, 1) + 0.0:.1f}" for value in column) for column in torque.T]
        for torque in (found.declared_nm, found.found_nm)
    )
    lines = [
        f"  {name}: {a} declared, {b} weighed;"
        for name, a, b in zip(joint_names, declared, weighed, strict=True)
    ]
    return ["  torque it adds, pose by pose [N·m]:", *lines[:-1], lines[-1].rstrip(";")]


def _point(at: Sequence[float] | FloatArray) -> str:
    return f"({', '.join(f'{x:.3f}' for x in at)})"


def _plain(value: FloatArray | float) -> Any:
    """JSON-ready, to a tenth of a gram and of a millinewton metre; None for what is unknown."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    return round(float(value), 4) if np.isfinite(value) else None
