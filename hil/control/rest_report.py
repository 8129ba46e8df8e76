"""Rest poses of a stored model: where model, station and surroundings meet.

The search itself (`hil.control.rest_pose`) knows none of them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.arms import AnyPayload, ArmDescription, Payload, payload_of
from hil.control.rest_place import place_of
from hil.control.rest_pose import RestPose, described, least_loaded
from hil.control.resting import RestingArm
from hil.core import AnyPath, FloatArray, PlanError, SpecError, path_of, whole_number
from hil.estimators import (
    RobotEstimator,
    gravity_torque,
    holding_friction,
    load_model_file,
    require_torque,
)
from hil.excitation import Workspace
from hil.planning import collision_model, roadmap_of

if TYPE_CHECKING:
    from hil.dynamics import CollisionModel

LIMIT_MARGIN_DEG = 2.0
"""Kept from the limits of the joints."""

NO_FRICTION = (
    "the model has no dry friction, so it is not known what the joints hold by themselves; "
    "estimators with a friction part (rigid-hysteresis, rigid-wls, static-coulomb) have one"
)
UNCHECKED = "clearance was not checked: see for yourself that the arm can be there"


@dataclass(frozen=True, slots=True, eq=False)
class RestReport:
    """Rest poses, and what they are better than.

    Attributes:
        model: Folder of the model.
        robot: Its robot.
        joint_names: Length n.
        around: What the clearance was checked against, in words.
        clearance_m: Distance that was kept.
        payload: What is mounted.
        limit: (n,) torque limits [N·m].
        friction: (n,) what the joints hold by friction [N·m] (`holding_friction`), None where the
            model does not know it.
        deviation: (n,) of what the model was fitted to from it [N·m], one standard deviation;
            stick friction is part of it.
        poses: The poses found, the best first.
        compared: `home`, where programs of this arm begin, and the pose given.
        seconds: The search took.
        notes: What else one should know.
    """

    model: str
    robot: str
    joint_names: tuple[str, ...]
    around: str
    clearance_m: float
    payload: Payload
    limit: FloatArray
    friction: FloatArray | None
    deviation: FloatArray
    poses: tuple[RestPose, ...]
    compared: tuple[RestPose, ...]
    seconds: float
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil rest-pose --json`."""
        return {
            "model": self.model,
            "robot": self.robot,
            "joint_names": list(self.joint_names),
            "around": self.around,
            "clearance_mm": 1e3 * self.clearance_m,
            "payload": {"mass_kg": self.payload.mass, "com_m": list(self.payload.com)},
            "torque_limit_nm": self.limit.tolist(),
            "dry_friction_nm": None if self.friction is None else self.friction.tolist(),
            "model_deviation_nm": self.deviation.tolist(),
            "poses": [pose.to_dict() for pose in self.poses],
            "compared": [pose.to_dict() for pose in self.compared],
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


def rest_poses(
    model: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    clearance_mm: float | None = None,
    near_deg: Sequence[float] | None = None,
    count: int = 3,
    seed: int = 0,
    unchecked: bool = False,
) -> RestReport:
    """The poses in which a model's arm loads its brakes least.

    Args:
        model: Its folder.
        station: Says what stands around the arm; by default the one experiments here would use,
            or a table at its base.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted.
        clearance_mm: Distance that is kept; by default the station's.
        near_deg: Where the arm stands now, or would rather be [°].
        count: How many poses.
        seed: Of the search.
        unchecked: Leave clearance out, the only way for an arm without collision bodies.

    Raises:
        DataError: The model cannot be read.
        FitError: The model has no gravity, or cannot tell torques.
        SpecError: The robot is another arm, or an argument cannot be.
        PlanError: No pose is within limits and clear.
    """
    folder, at = path_of(model), path_of(station) if station else None
    load = payload_of(payload) or Payload()
    count, seed = whole_number(count, "count", 1), whole_number(seed, "seed", 0)
    stored = load_model_file(folder)
    require_torque(stored)
    near = None if near_deg is None else _pose(near_deg, stored)
    place, around = place_of(stored, at, robot)
    clearance = place.surroundings.clearance_m if clearance_mm is None else 1e-3 * clearance_mm
    if not 0 <= clearance < np.inf:
        raise SpecError(
            f"a clearance of {1e3 * clearance:g} mm cannot be kept",
            hint="--clearance-mm takes 0 or more, and less than the arm is long",
        )
    arm = None if unchecked else _described_arm(stored, load)
    bodies = collision_model(arm, place.surroundings, [(load, None)]) if arm else None
    begin = time.perf_counter()
    resting = _resting(stored, load, bodies, clearance)
    poses = least_loaded(resting, near=near, count=count, seed=seed)
    compared = [] if bodies is None else _home(resting, bodies)
    compared += [] if near is None else [described(resting, near, "given")]
    return RestReport(
        model=str(folder),
        robot=stored.robot_.arm.name if stored.robot_.arm else stored.robot_.name,
        joint_names=stored.joint_names_,
        around="unchecked" if unchecked else around,
        clearance_m=0.0 if unchecked else clearance,
        payload=load,
        limit=resting.limit,
        friction=resting.friction,
        deviation=stored.sigma_ * stored.torque_scale_,
        poses=poses,
        compared=tuple(compared),
        seconds=time.perf_counter() - begin,
        notes=tuple(_notes(stored, resting, unchecked)),
    )


def _resting(
    model: RobotEstimator, load: Payload, bodies: CollisionModel | None, clearance_m: float
) -> RestingArm:
    margin = np.radians(LIMIT_MARGIN_DEG)
    return RestingArm(
        joint_names=model.joint_names_,
        gravity=lambda q: gravity_torque(model, q, load),
        limit=model.robot_.effort_max,
        low=model.robot_.q_min + margin,
        high=model.robot_.q_max - margin,
        friction=holding_friction(model),
        around=bodies,
        clearance_m=clearance_m,
    )


def _home(arm: RestingArm, bodies: CollisionModel) -> list[RestPose]:
    """Where programs of this arm begin by default; [] where they cannot."""
    description = bodies.arm
    workspace = Workspace(
        joint_names=arm.joint_names,
        q_min=description.q_min,
        q_max=description.q_max,
        low=description.excite_min,
        high=description.excite_max,
        collision=bodies,
        clearance_m=arm.clearance_m,
        # A roadmap's home does not depend on how fast the arm gets there.
        velocity=1.0,
        acceleration=1.0,
        jerk=1.0,
        rate_hz=description.rate_hz,
    )
    try:
        home = roadmap_of(workspace).home
    except PlanError:
        return []
    return [described(arm, home, "home")]


def _described_arm(model: RobotEstimator, load: Payload) -> ArmDescription:
    """The arm with its collision bodies.

    Raises:
        SpecError: It has none, or cannot carry the load.
    """
    arm = model.robot_.arm
    if arm is None or not arm.capsules:
        raise SpecError(
            f"{model.robot_.name} has no collision bodies: nobody can tell which poses are clear",
            hint="with --unchecked only limits and torques count; look for yourself then",
        )
    if load.mass > arm.payload_max_kg:
        raise SpecError(
            f"a load of {load.mass:g} kg is beyond the {arm.payload_max_kg:g} kg the {arm.name} "
            "is rated for",
            hint="give the load that is mounted: --payload M",
        )
    return arm


def _pose(degrees: Sequence[float], model: RobotEstimator) -> FloatArray:
    q = np.radians(np.asarray(degrees, dtype=np.float64))
    if q.shape != model.sigma_.shape or not np.isfinite(q).all():
        raise SpecError(
            f"{len(degrees)} joint angles were given, the model has {len(model.joint_names_)}",
            hint="for example: --near 0,-90,0,-90,0,0 (degrees)",
        )
    return np.asarray(q)


def _notes(model: RobotEstimator, arm: RestingArm, unchecked: bool) -> list[str]:
    deviation = ", ".join(f"{sigma:.1f}" for sigma in model.sigma_ * model.torque_scale_)
    told = [
        f"what was measured deviates from the model by {deviation} N·m, stick friction included: "
        "torques far below that are as good as none"
    ]
    told += [NO_FRICTION] if arm.friction is None else []
    return [*told, UNCHECKED] if unchecked else told
