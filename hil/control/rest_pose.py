"""The pose in which an arm loads its brakes least (future work of the static paper, section V).

What counts is the root mean square of the joints' torques, each as a share of its limit. On most
arms a whole family of poses loads no brake at all; among equals the one comes first that does
least when the brakes fail, then the one with most room.

**The search.** The torques of gravity are functions of the pose with many valleys, so many searches
are started from well-spread clear poses: sequential quadratic programming (SLSQP, Kraft 1988) on
the sum of squared shares of the torque limits, with the limits of the joints and every distance as
constraints.

**When the brakes let go** the arm stays, is held by friction, tips over or falls. An arm at rest is
a ball on a landscape, its potential energy. Where the gravity torques vanish the landscape is
level, and its curvature (the Hessian, here `RestingArm.stiffness`) says whether that is a valley, a
summit or a saddle: an arm that stands upright loads no brake, and falls at the first touch.
Directions without curvature (a base joint that turns about the vertical) go anywhere and nowhere.
Dry friction of the joints makes every slope that is gentle enough a place to stay. Only half of it
is counted: models overestimate it (`hil.control.hand_guiding`), and warmth takes some.

`rest_poses` finds model, station and surroundings; the search knows none of them, but a
`RestingArm`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from hil.arms import AnyPayload, ArmDescription, Payload, payload_of
from hil.control.model_robot import place_of
from hil.core import AnyPath, BoolArray, FloatArray, PlanError, SpecError, path_of, whole_number
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


LIMIT_MARGIN_DEG = 2.0
"""Kept from the limits of the joints."""

NO_FRICTION = (
    "the model has no dry friction, so it is not known what the joints hold by themselves; "
    "estimators with a friction part (rigid-hysteresis, rigid-wls, static-coulomb) have one"
)

UNCHECKED = "clearance was not checked: see for yourself that the arm can be there"


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


def _pose(degrees: Sequence[float], model: RobotEstimator) -> FloatArray:
    q = np.radians(np.asarray(degrees, dtype=np.float64))
    if q.shape != model.sigma_.shape or not np.isfinite(q).all():
        raise SpecError(
            f"{len(degrees)} joint angles were given, the model has {len(model.joint_names_)}",
            hint="for example: --near 0,-90,0,-90,0,0 (degrees)",
        )
    return np.asarray(q)


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


def _notes(model: RobotEstimator, arm: RestingArm, unchecked: bool) -> list[str]:
    deviation = ", ".join(f"{sigma:.1f}" for sigma in model.sigma_ * model.torque_scale_)
    told = [
        f"what was measured deviates from the model by {deviation} N·m, stick friction included: "
        "torques far below that are as good as none"
    ]
    told += [NO_FRICTION] if arm.friction is None else []
    return [*told, UNCHECKED] if unchecked else told


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """A pose, and what it asks of the brakes.

    Attributes:
        label: Why it is shown.
        q: (n,) [rad].
        torque: (n,) [N·m] that hold the arm.
        share: (n,) of the torque limits, with sign.
        effort: Root mean square of the shares.
        clearance: Smallest distance to anything [m]; infinite where none was checked.
        bodies: Between which two bodies that is.
        clear: Whether limits and clearance are kept.
        fail: What happens when the brakes fail.
    """

    label: str
    q: FloatArray
    torque: FloatArray
    share: FloatArray
    effort: float
    clearance: float
    bodies: tuple[str, str]
    clear: bool
    fail: BrakesFail

    def to_dict(self) -> dict[str, Any]:
        """As JSON; angles in degrees, distances in mm."""
        return {
            "label": self.label,
            "q_deg": np.degrees(self.q).tolist(),
            "q_rad": self.q.tolist(),
            "torque_nm": self.torque.tolist(),
            "share_percent": (100 * self.share).tolist(),
            "effort_percent": 100 * self.effort,
            "clearance_mm": 1e3 * self.clearance,
            "closest": list(self.bodies),
            "clear": self.clear,
            "brakes_fail": self.fail.to_dict(),
        }


def described(arm: RestingArm, q: FloatArray, label: str) -> RestPose:
    """What the pose `q` (n,) asks of the brakes."""
    torque = arm.gravity(q[None])[0]
    distance, bodies = arm.closest(q)
    return RestPose(
        label=label,
        q=q,
        torque=torque,
        share=torque / arm.limit,
        effort=float(arm.effort(q[None])[0]),
        clearance=distance,
        bodies=bodies,
        clear=bool(arm.is_clear(q[None])[0]),
        fail=brakes_fail(arm, q),
    )


APART_RAD = 0.5
"""Poses count as different when some joint differs by as much."""

EQUAL_SHARE = 5e-4
"""Efforts that differ by less are equal: no model knows torques better."""

NEAR_SHARE = 0.01
"""How much more effort than the least a pose near to a given one may cost."""

LEAST = "least torque"

STAYING = "least torque that stays or is held without brakes"

NEAREST = "nearest to the pose given"

ANOTHER = "another valley"

ORDER = ("stays", "held", "tips", "falls")


def least_loaded(
    arm: RestingArm, *, near: FloatArray | None = None, count: int = 3, seed: int = 0
) -> tuple[RestPose, ...]:
    """Poses that load the brakes least, the best first; the same arguments give the same poses.

    First comes the least effort of all; then, unless it is the same pose, the least effort among
    poses that do not fall when the brakes fail, if there is one; then the pose nearest to `near`
    that costs hardly more than the least. What is left of `count` are other valleys.

    Args:
        arm: The arm.
        near: (n,) where it would rather be [rad].
        count: How many poses at most; one that is asked for by `near` is always among them.
        seed: Of the poses the search starts from.

    Raises:
        PlanError: No clear pose was found.
    """
    starts = starts_of(arm, seed)
    free = free_joints(arm, starts)
    wanted = np.zeros(arm.n) if near is None else near
    reached = [turned(arm, least_effort(arm, start), free, wanted) for start in starts]
    found = [described(arm, q, "") for q in reached]
    found = _distinct(sorted((pose for pose in found if pose.clear), key=_rank), free)
    if not found:
        raise none_clear(arm, starts)
    chosen = [replace(found[0], label=LEAST)]
    if staying := _first_staying(found):
        _add(chosen, staying, STAYING, free)
    if near is not None:
        chosen.append(replace(_nearest(arm, near, found), label=NEAREST))
    others = [pose for pose in found if all(_apart(pose.q, one.q, free) for one in chosen)]
    chosen += [replace(pose, label=ANOTHER) for pose in others[: max(0, count - len(chosen))]]
    return tuple(chosen)


DRAWN = 4096
"""Well-spread poses that are looked at; a power of two."""

STARTS = 24
"""Local searches, a multiple of three."""

LIGHT = 256
"""Of the poses looked at, so many of the least effort are asked whether they lie in a valley."""

SPARE_M = 1e-5
"""Kept beyond the clearance, so that rounding does not fall below it."""

FTOL = 1e-8
"""A search ends when percent squared, or squared radians, change by less."""

Cost = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value and gradient (n,) at q (n,)."""


def starts_of(arm: RestingArm, seed: int) -> FloatArray:
    """(≤ STARTS, n) well-spread clear poses of little effort.

    Raises:
        PlanError: None of the poses that were looked at is clear.
    """
    from scipy.stats import qmc

    low, high = drawn_range(arm)
    points = qmc.Sobol(arm.n, scramble=True, rng=np.random.default_rng(seed)).random(DRAWN)
    drawn = low + points * (high - low)
    clear = drawn[arm.is_clear(drawn)]
    if len(clear) == 0:
        raise none_clear(arm, drawn)
    clear = clear[np.argsort(arm.effort(clear), kind="stable")]
    # A third are the best, a third lie in the roundest valleys of the potential energy, where the
    # arm hangs; the others keep the search from seeing one valley only.
    third = STARTS // 3
    spread = clear[third :: max(1, len(clear) // third)][:third]
    return np.concatenate([clear[:third], _in_valleys(arm, clear[:LIGHT], third), spread])


def _in_valleys(arm: RestingArm, poses: FloatArray, count: int) -> FloatArray:
    """(≤ count, n) of the `poses` (N, n) those whose least curvature is largest."""
    least = np.array([curvatures(arm, q)[0][0] for q in poses])
    return poses[np.argsort(-least, kind="stable")[:count]]


def drawn_range(arm: RestingArm) -> tuple[FloatArray, FloatArray]:
    """Range (n,), (n,) that holds every pose once: one turn about 0 where the limits allow more."""
    centre = np.clip(0.0, arm.low + np.pi, np.maximum(arm.high - np.pi, arm.low + np.pi))
    centre = np.where(np.isfinite(centre), centre, 0.0)
    return np.maximum(arm.low, centre - np.pi), np.minimum(arm.high, centre + np.pi)


def none_clear(arm: RestingArm, looked_at: FloatArray) -> PlanError:
    """The error that says how far from clear the poses `looked_at` (N, n) are."""
    distances = [arm.closest(q) for q in looked_at[:256]]
    roomiest, (a, b) = max(distances)
    return PlanError(
        f"none of the poses looked at keeps {1e3 * arm.clearance_m:.0f} mm clear; the roomiest has "
        f"{1e3 * roomiest:.0f} mm between {a} and {b}",
        hint="ask for less with --clearance-mm, or see whether the station's surroundings are as "
        "described",
    )


def free_joints(arm: RestingArm, q: FloatArray) -> BoolArray:
    """(n,) joints that no torque depends on, judged at `q` (N, n): turning them changes nothing."""
    slopes = np.array([arm.stiffness(pose) / arm.limit[:, None] for pose in q])
    return np.asarray(np.abs(slopes).max(axis=(0, 1)) < INDIFFERENT)


def turned(arm: RestingArm, q: FloatArray, free: BoolArray, wanted: FloatArray) -> FloatArray:
    """The pose `q` (n,) with its free joints at `wanted` (n,), wherever that is clear."""
    for joint in np.flatnonzero(free):
        other = q.copy()
        other[joint] = np.clip(wanted[joint], arm.low[joint], arm.high[joint])
        q = other if arm.is_clear(other[None])[0] else q
    return q


def least_effort(arm: RestingArm, start: FloatArray) -> FloatArray:
    """The pose (n,) of least effort that is reached from `start` (n,)."""
    return _search(arm, start, lambda q: _effort_cost(arm, q))


def nearest_within(
    arm: RestingArm, near: FloatArray, effort: float, starts: Iterable[FloatArray]
) -> list[FloatArray]:
    """The poses (n,) nearest to `near` with at most that effort that are reached from `starts`."""
    bound = {
        "type": "ineq",
        "fun": lambda q: arm.n * (100 * effort) ** 2 - _effort_cost(arm, q)[0],
        "jac": lambda q: -_effort_cost(arm, q)[1],
    }

    def cost(q: FloatArray) -> tuple[float, FloatArray]:
        return float(np.sum((q - near) ** 2)), 2.0 * (q - near)

    return [_search(arm, np.clip(start, arm.low, arm.high), cost, bound) for start in starts]


def _effort_cost(arm: RestingArm, q: FloatArray) -> tuple[float, FloatArray]:
    """Sum of squared shares in percent, and its gradient."""
    torque, stiffness = arm.torque_and_stiffness(q)
    percent = 100.0 * torque / arm.limit
    slopes = 100.0 * stiffness / arm.limit[:, None]
    return float(percent @ percent), 2.0 * slopes.T @ percent


def _search(arm: RestingArm, start: FloatArray, cost: Cost, *constraints: Any) -> FloatArray:
    """The local optimum (n,) that SLSQP finds from `start` (n,)."""
    from scipy.optimize import minimize

    if arm.around is not None:
        room = {"fun": lambda q: arm.room(q) - SPARE_M, "jac": arm.room_slopes}
        constraints = (*constraints, {"type": "ineq", **room})
    done = minimize(
        cost,
        start,
        jac=True,
        method="SLSQP",
        bounds=list(zip(arm.low, arm.high, strict=True)),
        constraints=constraints,
        options={"maxiter": 100, "ftol": FTOL},
    )
    reached: FloatArray = np.clip(np.asarray(done.x), arm.low, arm.high)
    return reached


def _distinct(poses: Iterable[RestPose], free: BoolArray) -> list[RestPose]:
    kept: list[RestPose] = []
    for pose in poses:
        if all(_apart(pose.q, other.q, free) for other in kept):
            kept.append(pose)
    return kept


def _rank(pose: RestPose) -> tuple[float, ...]:
    outcome = ORDER.index(pose.fail.outcome)
    return round(pose.effort / EQUAL_SHARE), outcome, -round(pose.clearance, 3), pose.effort


def _first_staying(found: Sequence[RestPose]) -> RestPose | None:
    """The best pose of the safest outcome there is, unless all of them would come down."""
    safest = min(found, key=lambda pose: (ORDER.index(pose.fail.outcome), _rank(pose)))
    return safest if safest.fail.outcome in ("stays", "held") else None


def _add(chosen: list[RestPose], pose: RestPose, label: str, free: BoolArray) -> None:
    """Add a pose, or the label alone where the pose is among those chosen already."""
    for i, other in enumerate(chosen):
        if not _apart(pose.q, other.q, free):
            chosen[i] = replace(other, label=f"{other.label}, {label}")
            return
    chosen.append(replace(pose, label=label))


def _nearest(arm: RestingArm, near: FloatArray, found: Sequence[RestPose]) -> RestPose:
    """The pose nearest to `near` that costs at most `NEAR_SHARE` more than the least."""
    most = found[0].effort + NEAR_SHARE
    by_way = sorted(found, key=lambda pose: _far(pose.q, near))[:3]
    reached = nearest_within(arm, near, most, [near, *(pose.q for pose in by_way)])
    poses = [*found, *(described(arm, q, "") for q in reached)]
    cheap = [pose for pose in poses if pose.clear and pose.effort <= most * (1 + 1e-6)]
    return min(cheap, key=lambda pose: _far(pose.q, near))


def _far(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b))


def _apart(a: FloatArray, b: FloatArray, free: BoolArray) -> bool:
    """Whether two poses differ; whole turns and free joints do not count."""
    turn = np.remainder(a - b + np.pi, 2 * np.pi) - np.pi
    return bool(np.max(np.abs(turn[~free]), initial=0.0) > APART_RAD)


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


def _outcome(balanced: bool, way_down: bool, held: bool) -> Outcome:
    if balanced and not way_down:
        return "stays"
    if held:
        return "held"
    return "tips" if balanced else "falls"


def _largest_one(direction: FloatArray) -> FloatArray:
    largest: float = direction[np.argmax(np.abs(direction))]
    return np.asarray(direction / largest)


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


STIFFNESS_STEP_RAD = 1e-4
"""Of the central differences of the torque."""

DISTANCE_STEP_RAD = 1e-6
"""Of the forward differences of distances, which have kinks."""

TOLERANCE_RAD = 1e-9

TOLERANCE_M = 1e-7


class Distances(Protocol):
    """What is needed of a collision model (`hil.dynamics.CollisionModel`)."""

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n); negative where bodies overlap."""

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and between which two bodies."""


@dataclass(frozen=True, eq=False)
class RestingArm:
    """An arm that is to stand still with its brakes on.

    Attributes:
        joint_names: Length n.
        gravity: (N, n) torques [N·m] that hold the arm and its load at positions (N, n).
        limit: (n,) torque limits [N·m], the measure of every torque.
        low, high: (n,) range of the joints [rad], margin taken off; infinite for endless joints.
        friction: (n,) dry friction [N·m], None where nobody knows.
        around: Distances to itself and its surroundings; None leaves them unchecked.
        clearance_m: Distance that is kept.

    Raises:
        PlanError: The range of a joint is empty, or a torque limit is missing.
    """

    joint_names: tuple[str, ...]
    gravity: Callable[[FloatArray], FloatArray]
    limit: FloatArray
    low: FloatArray
    high: FloatArray
    friction: FloatArray | None = None
    around: Distances | None = None
    clearance_m: float = 0.0

    def __post_init__(self) -> None:
        self._refuse(
            self.low >= self.high, "no position is within the limits of", "lower the margin"
        )
        self._refuse(
            ~(np.isfinite(self.limit) & (self.limit > 0)),
            "the robot model has no torque limits for",
            "write them into the URDF (<limit effort=…>)",
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def share(self, q: FloatArray) -> FloatArray:
        """(N, n) torque as a share of the limit, with its sign, at `q` (N, n)."""
        share: FloatArray = self.gravity(q) / self.limit
        return share

    def effort(self, q: FloatArray) -> FloatArray:
        """(N,) root mean square of the shares: what the search makes small."""
        return np.asarray(np.sqrt(np.mean(self.share(q) ** 2, axis=1)))

    def stiffness(self, q: FloatArray) -> FloatArray:
        """(n, n) change of the gravity torques per joint angle [N·m/rad] at `q` (n,).

        The Hessian of the potential energy, wherever the torques have one.
        """
        return self.torque_and_stiffness(q)[1]

    def torque_and_stiffness(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) torques [N·m] and (n, n) `stiffness` at `q` (n,), from one call of the model."""
        step = STIFFNESS_STEP_RAD * np.eye(self.n)
        torque = self.gravity(np.concatenate([q[None], q + step, q - step]))
        change = (torque[1 : self.n + 1] - torque[self.n + 1 :]) / (2 * STIFFNESS_STEP_RAD)
        return torque[0], change.T

    def room(self, q: FloatArray) -> FloatArray:
        """(R,) distances beyond the clearance [m] at `q` (n,); empty where nothing is checked."""
        return self._rooms(q[None])[:, 0]

    def room_slopes(self, q: FloatArray) -> FloatArray:
        """(R, n) derivative of `room` at `q` (n,)."""
        moved = np.concatenate([q[None], q + DISTANCE_STEP_RAD * np.eye(self.n)])
        rooms = self._rooms(moved)
        slopes: FloatArray = (rooms[:, 1:] - rooms[:, :1]) / DISTANCE_STEP_RAD
        return slopes

    def is_clear(self, q: FloatArray) -> BoolArray:
        """(N,) whether each of `q` (N, n) is within limits and keeps its distance."""
        low, high = self.low - TOLERANCE_RAD, self.high + TOLERANCE_RAD
        inside = np.all((q >= low) & (q <= high), axis=1)
        least = self._rooms(q).min(axis=0, initial=np.inf)
        return np.asarray(inside & (least >= -TOLERANCE_M))

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Smallest distance [m] at `q` (n,), and between what; infinite where unchecked."""
        return (np.inf, ("", "")) if self.around is None else self.around.closest(q)

    def _rooms(self, q: FloatArray) -> FloatArray:
        if self.around is None:
            return np.empty((0, len(q)))
        rooms: FloatArray = self.around.distances(q) - self.clearance_m
        return rooms

    def _refuse(self, wrong: BoolArray, what: str, hint: str) -> None:
        if np.any(wrong):
            named = [n for n, bad in zip(self.joint_names, wrong, strict=True) if bad]
            raise PlanError(f"{what} {', '.join(named)}", hint=hint)
