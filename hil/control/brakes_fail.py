"""What an arm does when its brakes let go: stays, is held by friction, tips over, falls.

An arm at rest is a ball on a landscape, its potential energy. Where the gravity torques vanish the
landscape is level, and its curvature (the Hessian, here `RestingArm.stiffness`) says whether that
is a valley, a summit or a saddle: an arm that stands upright loads no brake, and falls at the first
touch. Directions without curvature (a base joint that turns about the vertical) go anywhere and
nowhere. Dry friction of the joints makes every slope that is gentle enough a place to stay. Only
half of it is counted: models overestimate it (`hil.control.hand_guiding`), and warmth takes some.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hil.control.resting import RestingArm
from hil.core import FloatArray

Outcome = Literal["stays", "held", "tips", "falls"]

BALANCED_SHARE = 0.005
"""Below this share of its limit a joint's torque counts as none."""

COUNTED = 0.5
"""Share of the model's dry friction that is relied upon."""

INDIFFERENT = 1e-3
"""Share of the limits that a radian changes, at most, along a direction that is level."""


@dataclass(frozen=True, slots=True, eq=False)
class BrakesFail:
    """What happens without brakes and without drives.

    Attributes:
        outcome: `stays` (no torque, no way down), `held` (by dry friction alone), `tips` (no
            torque, but a way down, and no friction known to hold it there) or `falls`.
        balanced: Whether every torque is below `BALANCED_SHARE` of its limit.
        stable, unstable, indifferent: Number of independent directions that lead up, down, level.
        way_down: (n,) the steepest unstable direction, largest entry 1; zeros without one.
        spare: (n,) dry friction that is counted less torque [N·m]; NaN where none is known.
    """

    outcome: Outcome
    balanced: bool
    stable: int
    unstable: int
    indifferent: int
    way_down: FloatArray
    spare: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "outcome": self.outcome,
            "balanced": self.balanced,
            "directions": {
                "stable": self.stable,
                "unstable": self.unstable,
                "indifferent": self.indifferent,
            },
            "way_down": self.way_down.tolist(),
            "friction_spare_nm": self.spare.tolist(),
        }


def brakes_fail(arm: RestingArm, q: FloatArray) -> BrakesFail:
    """What the arm does at `q` (n,) when all brakes fail at once."""
    torque = arm.gravity(q[None])[0]
    balanced = bool(np.all(np.abs(torque) <= BALANCED_SHARE * arm.limit))
    known = np.full(arm.n, np.nan) if arm.friction is None else arm.friction
    spare = COUNTED * known - np.abs(torque)
    curvature, directions = curvatures(arm, q)
    down, up = curvature < -INDIFFERENT, curvature > INDIFFERENT
    return BrakesFail(
        outcome=_outcome(balanced, bool(down.any()), bool(np.all(spare > 0))),
        balanced=balanced,
        stable=int(up.sum()),
        unstable=int(down.sum()),
        indifferent=int((~up & ~down).sum()),
        way_down=_largest_one(directions[:, 0]) if down.any() else np.zeros(arm.n),
        spare=spare,
    )


def curvatures(arm: RestingArm, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) curvatures of the potential energy at `q` (n,), ascending, and (n, n) directions.

    Joints are measured by their limits, so that a curvature is the share of its limit a torque
    changes by per radian. Signs, and so the count of each, do not depend on that (Sylvester's law
    of inertia). Torques of independent regressions (eq. 15 of the static paper) need not have a
    potential energy; the symmetric part stands for it.
    """
    weight = 1.0 / np.sqrt(arm.limit)
    K = arm.stiffness(q)
    curvature, vectors = np.linalg.eigh(weight[:, None] * (0.5 * (K + K.T)) * weight)
    return curvature, weight[:, None] * vectors


def _outcome(balanced: bool, way_down: bool, held: bool) -> Outcome:
    if balanced and not way_down:
        return "stays"
    if held:
        return "held"
    return "tips" if balanced else "falls"


def _largest_one(direction: FloatArray) -> FloatArray:
    largest: float = direction[np.argmax(np.abs(direction))]
    return np.asarray(direction / largest)
