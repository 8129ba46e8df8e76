"""Bounds of the inertial parameters of links: largest mass, bounding box and reference body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.dynamics import PARAMETERS, RobotModel, from_pseudo_inertia, pseudo_inertia

MASS_FACTOR = 1.3
"""Maximum ratio of link mass to nominal mass; allows for cables, covers and gain errors."""

LIGHT = 0.1
"""Share of the arm's mass that replaces a nominal link mass below it in the mass bound.

The replacement is necessary because tools are mounted on small flanges and are not always declared.
"""

AT_BOUND = 0.999
"""Share of its maximum mass above which a link counts as at its bound."""

MARGIN_SHARE = 0.1
"""Margin of a link's bounding box beyond joints and nominal body, as a share of the arm's reach."""

MOST_KG = 100.0
"""Maximum mass of a link [kg] if neither a nominal mass nor a torque limit is known."""

THINNEST = 0.02
"""Minimum standard deviation of the mass of a reference body, as a share of its box."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialBounds:
    """Bounds on the inertial parameters of every link, in Pinocchio's joint frames.

    Torques do not depend on some directions of the inertial parameters. A fit that is only
    physically consistent could assign masses of thousands of kilograms in these directions. To
    avoid such masses, the bounds use the nominal model and the geometry of the robot.

    Attributes:
        reference: (n, 10) physically consistent reference body of each link, strictly inside the
            bounds; the centre of the prior.
        mass_max: (n,) maximum mass of each link [kg].
        box: (n, 2, 3) lower and upper coordinates of the box that contains the mass of each link
            [m].
        notes: List of notes for the user on assumptions.
    """

    reference: FloatArray
    mass_max: FloatArray
    box: FloatArray
    notes: tuple[str, ...] = ()

    @classmethod
    def nominal(
        cls,
        robot: RobotModel,
        *,
        mass_factor: float = MASS_FACTOR,
    ) -> InertialBounds:
        """Return the bounds from the inertial parameters and the geometry of a robot model.

        The bounding box of a link contains its joint, the next joint and its nominal body, with a
        margin. Links with a nominal mass of 0 get wide bounds, and a note names these links.

        Args:
            robot: Nominal robot model.
            mass_factor: Maximum ratio of link mass to nominal mass, above 1. For links lighter than
                a tenth of the arm, a tenth of the mass of the arm replaces the nominal mass.
        """
        bodies = robot.parameters(rotor=False).reshape(robot.n, len(PARAMETERS))
        known = bodies[:, 0] > 0
        next_joint = _next_joints(robot)
        reach = float(np.sum(np.linalg.norm(next_joint, axis=1))) or 1.0
        margin = MARGIN_SHARE * reach
        box = np.stack(
            [_box(body, end, margin) for body, end in zip(bodies, next_joint, strict=True)]
        )
        unknown_max = _mass_from_torque(robot, reach)
        heavy = np.maximum(bodies[:, 0], LIGHT * float(np.sum(bodies[:, 0])))
        mass_max = np.where(known, mass_factor * heavy, unknown_max)
        reference = np.stack(
            [_body(b, m, x) for b, m, x in zip(bodies, mass_max, box, strict=True)]
        )
        return cls(reference, mass_max, box, _notes(robot, known, unknown_max))

    def reached(self, inertial: FloatArray, joint_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return notes on the links whose mass in `inertial` (11n,) is at its bound."""
        masses = inertial[: self.reference.size].reshape(self.reference.shape)[:, 0]
        heavy = masses >= AT_BOUND * self.mass_max
        if not np.any(heavy):
            return ()
        names = ", ".join(name for name, at in zip(joint_names, heavy, strict=True) if at)
        return (
            f"the link masses after {names} are at their upper bound: check for an undeclared "
            "payload, and that the robot model describes this arm",
        )


def _next_joints(robot: RobotModel) -> FloatArray:
    """Return (n, 3) the position of the next joint or the flange in each joint's frame [m]."""
    still = np.zeros((1, robot.n))
    placement = robot.joint_geometry().placement
    flange = robot.flange_pose(still)[0]
    last = np.eye(4)
    for pose in placement:
        last = last @ pose
    end = np.linalg.solve(last, flange)[:3, 3]
    return np.vstack([placement[1:, :3, 3], end])


def _box(body: FloatArray, end: FloatArray, margin: float) -> FloatArray:
    """Return (2, 3) the lowest and highest corner of the bounding box of a link."""
    points = [np.zeros(3), end]
    if body[0] > 0:
        centre = body[1:4] / body[0]
        spread = np.sqrt(np.maximum(np.diag(_central(body)) / body[0], 0.0))
        # Most of a body's mass is within two standard deviations of its centre.
        points += [centre - 2 * spread, centre + 2 * spread]
    return np.stack([np.min(points, axis=0) - margin, np.max(points, axis=0) + margin])


def _central(body: FloatArray) -> FloatArray:
    """Return (3, 3) the second moments of a body's mass about its centre [kg·m²]."""
    J, centre = pseudo_inertia(body), body[1:4] / body[0]
    return np.asarray(J[:3, :3] - body[0] * np.outer(centre, centre))


def _mass_from_torque(robot: RobotModel, reach: float) -> float:
    """Return twice the mass that the strongest joint can hold at the reach of the arm [kg]."""
    limited = np.isfinite(robot.effort_max) & (robot.effort_max > 0)
    if not limited.any():
        return MOST_KG
    arm_m = np.where(robot.joint_geometry().turns, reach, 1.0)  # prismatic joints have force limits
    return float(min(2.0 * (robot.effort_max / (9.81 * arm_m))[limited].max(), MOST_KG))


def _body(body: FloatArray, mass_max: float, box: FloatArray) -> FloatArray:
    """Return (10,) the nominal body with a minimum thickness, or a body that fills its box."""
    size = box[1] - box[0]
    if body[0] > 0:
        mass, centre, moments = body[0], body[1:4] / body[0], _central(body)
    else:
        mass, centre, moments = 0.1 * mass_max, box.mean(axis=0), np.zeros((3, 3))
        size = 5.0 * size
    values, vectors = np.linalg.eigh(moments)
    thin = mass * (THINNEST * float(size.min())) ** 2
    moments = (vectors * np.maximum(values, thin)) @ vectors.T
    J = np.zeros((4, 4))
    J[:3, :3] = moments + mass * np.outer(centre, centre)
    J[:3, 3] = J[3, :3] = mass * centre
    J[3, 3] = mass
    return from_pseudo_inertia(J)


def _notes(robot: RobotModel, known: BoolArray, mass_max: float) -> tuple[str, ...]:
    missing = [name for name, there in zip(robot.joint_names, known, strict=True) if not there]
    if not missing:
        return ()
    whose = "any link" if len(missing) == robot.n else f"the links of {', '.join(missing)}"
    return (
        f"the robot model {robot.name} contains no mass for {whose}: up to {mass_max:.3g} kg each "
        "are allowed, so parameters without effect on any joint torque are little more than a "
        "guess",
    )
