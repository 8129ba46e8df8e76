"""Bounds of a robot's links: how heavy each may be, where its mass lies, and a reference body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.dynamics import PARAMETERS, RobotModel, from_pseudo_inertia, pseudo_inertia

MASS_FACTOR = 1.3
"""A link is at most so many times as heavy as its nominal model: cables, covers, drive gains."""

LIGHT = 0.1
"""Share of the arm's mass below which a link counts as that heavy when its mass is bounded: tools
hang on small flanges and are not always declared."""

AT_BOUND = 0.999
"""Share of its greatest mass from which a link counts as being at the bound."""

MARGIN_SHARE = 0.1
"""Share of the arm's reach by which a link may stick out beyond its joints and nominal body."""

MOST_KG = 100.0
"""Bound on a link's mass where neither a nominal mass nor a torque limit is known."""

THINNEST = 0.02
"""A reference body is at least so thick, as a share of its box (standard deviation of mass)."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialBounds:
    """Bounds on the inertial parameters of every link, in Pinocchio's joint frames.

    Torques say nothing about some directions of the inertial parameters: a fit that is only
    physically consistent may put thousands of kilograms where no joint feels them. The robot's
    nominal model and its geometry know better.

    Attributes:
        reference: (n, 10) a body that can exist per link, strictly inside the bounds; the prior
            pulls towards it.
        mass_max: (n,) [kg].
        box: (n, 2, 3) lowest and highest coordinates of a link's mass [m].
        notes: What had to be assumed, for people.
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
        """Bounds from a robot's own inertial parameters and geometry.

        A link's box spans its joint, the next one and its nominal body, and a margin. Links whose
        nominal mass is 0 get wide bounds, and a note says so.

        Args:
            robot: The nominal model.
            mass_factor: Most mass of a link as a multiple of its nominal one, or of a tenth of
                the arm's where it is lighter; above 1.
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
        """Notes on links of full parameters (11n,) that are as heavy as they may be."""
        masses = inertial[: self.reference.size].reshape(self.reference.shape)[:, 0]
        heavy = masses >= AT_BOUND * self.mass_max
        if not np.any(heavy):
            return ()
        names = ", ".join(name for name, at in zip(joint_names, heavy, strict=True) if at)
        return (
            f"the links behind {names} are as heavy as they may be: was a load mounted that is not "
            "declared, or is the robot's nominal model of another arm?",
        )


def _next_joints(robot: RobotModel) -> FloatArray:
    """(n, 3) where the following joint (or the flange) sits in each joint's frame [m]."""
    still = np.zeros((1, robot.n))
    placement = robot.joint_geometry().placement
    flange = robot.flange_pose(still)[0]
    last = np.eye(4)
    for pose in placement:
        last = last @ pose
    end = np.linalg.solve(last, flange)[:3, 3]
    return np.vstack([placement[1:, :3, 3], end])


def _box(body: FloatArray, end: FloatArray, margin: float) -> FloatArray:
    """(2, 3) lowest and highest corner of the region a link may fill."""
    points = [np.zeros(3), end]
    if body[0] > 0:
        centre = body[1:4] / body[0]
        spread = np.sqrt(np.maximum(np.diag(_central(body)) / body[0], 0.0))
        # Twice the standard deviation of a body's mass is beyond most of what it is made of.
        points += [centre - 2 * spread, centre + 2 * spread]
    return np.stack([np.min(points, axis=0) - margin, np.max(points, axis=0) + margin])


def _central(body: FloatArray) -> FloatArray:
    """(3, 3) second moments of a body's mass about its centre [kg·m²]."""
    J, centre = pseudo_inertia(body), body[1:4] / body[0]
    return np.asarray(J[:3, :3] - body[0] * np.outer(centre, centre))


def _mass_from_torque(robot: RobotModel, reach: float) -> float:
    """Twice what the strongest joint could hold at arm's length [kg]."""
    limited = np.isfinite(robot.effort_max) & (robot.effort_max > 0)
    if not limited.any():
        return MOST_KG
    arm_m = np.where(robot.joint_geometry().turns, reach, 1.0)  # a sliding joint's limit is a force
    return float(min(2.0 * (robot.effort_max / (9.81 * arm_m))[limited].max(), MOST_KG))


def _body(body: FloatArray, mass_max: float, box: FloatArray) -> FloatArray:
    """(10,) the nominal body made thick enough to exist, or one that fills the box."""
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
        f"the robot model {robot.name} gives no mass of {whose}: up to {mass_max:.3g} kg each are "
        "allowed there, so that directions no joint feels are little more than a guess",
    )
