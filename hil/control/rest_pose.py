"""Poses of an arm with the minimum load on its brakes (future work of the static paper, section V).

The criterion of the search is the root mean square of the joint torques, each as a share of its
torque limit. Most arms have a whole family of poses in which no brake is loaded. Poses with equal
load are ranked by the behavior of the arm after a failure of the brakes, and then by clearance.

**Search.** Gravity torques are functions of the pose with many local minima, so that many local
searches are started from well-distributed collision-free poses. Each local search is sequential
quadratic programming (SLSQP, Kraft 1988) on the sum of squared shares of the torque limits, with
the joint limits and all distances as constraints.

**Failure of the brakes.** After a failure of the brakes, the arm stays, is held by friction, tips
over or falls. The potential energy of the arm determines its behavior after the failure. In poses
without gravity torques, the curvature of the potential energy (the Hessian, here
`RestingArm.stiffness`) distinguishes minima, maxima and saddle points: an upright arm loads no
brake and falls after the slightest touch. Directions in which the potential energy has no curvature
(a base joint that rotates about the vertical) are indifferent. Dry friction of the joints holds the
arm if the gravity torques are small enough. Only half of the dry friction of the model is counted,
because models overestimate the dry friction (`hil.control.hand_guiding`) and warm joints have less
friction.

The function `rest_poses` determines model, station and surroundings; the search itself depends only
on a `RestingArm`.
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
    """Result of a search: rest poses, and other poses for comparison.

    Attributes:
        model: Path of the model folder.
        robot: Name of the robot of the model.
        joint_names: Names of the n joints.
        around: Description of the surroundings for which the clearance was computed.
        clearance_m: Required clearance [m].
        payload: Mounted payload.
        limit: (n,) torque limits [N·m].
        friction: (n,) holding torque of the dry friction [N·m] (`holding_friction`); None if the
            model does not contain dry friction.
        deviation: (n,) standard deviation of the training data from the model [N·m], including
            stick friction.
        poses: Rest poses in the order from best to worst.
        compared: Poses for comparison: `home`, which is the start pose of programs of this arm, and
            the pose passed by the user.
        seconds: Duration of the search [s].
        notes: Further notes.
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
        """Return the document that `hil rest-pose --json` prints."""
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
"""Margin by which poses stay within the joint limits [°]."""

NO_FRICTION = (
    "the model contains no dry friction, so the torque that joints hold without drives is unknown; "
    "use an estimator with a friction part (rigid-hysteresis, rigid-wls, static-coulomb)"
)

UNCHECKED = "clearance was not checked: make sure that the pose is free of collisions"


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
    """Return the poses in which the arm of a model has the minimum load on its brakes.

    Args:
        model: Path of the model folder.
        station: Path of the station file that describes the surroundings; by default the default
            station of experiments in the working directory, or a table at the base of the arm.
        robot: Name of the robot in the station; by default the only robot that matches the model.
        payload: Payload that is mounted: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a
            `Payload`.
        clearance_mm: Minimum clearance of the poses [mm]; by default the clearance of the station.
        near_deg: Present or preferred joint angles of the arm [°].
        count: Number of poses to return.
        seed: Seed of the start poses of the search.
        unchecked: Whether to skip the check of the clearance; required for an arm without collision
            bodies.

    Raises:
        DataError: The model cannot be read.
        FitError: The model has no gravity part, or cannot predict torques.
        SpecError: The robot in the station is a different arm, or an argument is invalid.
        PlanError: No pose satisfies the joint limits and the clearance.
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
            f"invalid clearance: {1e3 * clearance:g} mm",
            hint="set --clearance-mm to at least 0, and to less than the length of the arm",
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
    """Return the description of the static arm with its collision bodies.

    Raises:
        SpecError: The arm has no collision bodies, or the payload exceeds its rated payload.
    """
    arm = model.robot_.arm
    if arm is None or not arm.capsules:
        raise SpecError(
            f"{model.robot_.name} has no collision bodies, so clearance cannot be checked",
            hint="use --no-collision-check to check limits and torques only",
        )
    if load.mass > arm.payload_max_kg:
        raise SpecError(
            f"a load of {load.mass:g} kg is beyond the {arm.payload_max_kg:g} kg the {arm.name} "
            "is rated for",
            hint="set the mounted payload: --payload M",
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
    """Return the default start pose of programs of this arm; an empty list without one."""
    description = bodies.arm
    workspace = Workspace(
        joint_names=arm.joint_names,
        q_min=description.q_min,
        q_max=description.q_max,
        low=description.excite_min,
        high=description.excite_max,
        collision=bodies,
        clearance_m=arm.clearance_m,
        # The home pose of a roadmap does not depend on the speed of the arm.
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
        f"the measurements deviate from the model by {deviation} N·m, including stick friction: "
        "much smaller torques are equal to zero within this accuracy"
    ]
    told += [NO_FRICTION] if arm.friction is None else []
    return [*told, UNCHECKED] if unchecked else told


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """Pose of the arm with its load on the brakes.

    Attributes:
        label: Reason why the pose is in the list.
        q: (n,) joint positions [rad].
        torque: (n,) holding torques [N·m].
        share: (n,) torque of each joint as a share of its limit, with sign.
        effort: Root mean square of the torque shares.
        clearance: Minimum distance between two bodies [m]; infinite if distances are not checked.
        bodies: Names of the two bodies with the minimum distance.
        clear: Whether the pose satisfies joint limits and clearance.
        fail: Behavior of the arm after a failure of the brakes.
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
        """Return the pose as JSON data; angles in degrees, distances in mm."""
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
    """Return the pose `q` (n,) with its load on the brakes."""
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
"""Minimum difference of a joint angle between poses that count as different [rad]."""

EQUAL_SHARE = 5e-4
"""Difference of effort (RMS torque share) below which two efforts count as equal; no model is
more accurate."""

NEAR_SHARE = 0.01
"""Maximum additional effort of the pose nearest to a preferred pose, relative to the minimum
effort."""

LEAST = "least torque"

STAYING = "least torque that stays or is held without brakes"

NEAREST = "nearest to the requested pose"

ANOTHER = "different local minimum"

ORDER = ("stays", "held", "tips", "falls")


def least_loaded(
    arm: RestingArm, *, near: FloatArray | None = None, count: int = 3, seed: int = 0
) -> tuple[RestPose, ...]:
    """Return the poses with the minimum load on the brakes, best first; deterministic.

    The first returned pose has the minimum effort. The second returned pose is the best pose in
    which the arm stays or is held after a brake failure; this pose is omitted if it equals the
    first pose or does not exist. If `near` is passed, the next pose is the pose nearest to `near`
    with nearly the minimum effort. The remaining returned poses, up to `count`, are other local
    minima.

    Args:
        arm: Resting arm.
        near: (n,) preferred pose [rad].
        count: Maximum number of poses; the pose for `near` is always included.
        seed: Seed of the start poses of the search.

    Raises:
        PlanError: The search found no collision-free pose.
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
"""Number of well-distributed candidate poses of the search; a power of two."""

STARTS = 24
"""Number of local searches of a run; a multiple of three."""

LIGHT = 256
"""Number of candidate poses of minimum effort whose curvature is evaluated."""

SPARE_M = 1e-5
"""Margin that is added to the clearance against rounding errors [m]."""

FTOL = 1e-8
"""Change of the cost (squared percent or squared radians) below which a local search ends."""

Cost = Callable[[FloatArray], tuple[float, FloatArray]]
"""Cost function of a local search: value and gradient (n,) at q (n,)."""


def starts_of(arm: RestingArm, seed: int) -> FloatArray:
    """Return at most STARTS well-distributed collision-free poses of low effort, (≤ STARTS, n).

    Raises:
        PlanError: No candidate pose is collision-free.
    """
    from scipy.stats import qmc

    low, high = drawn_range(arm)
    points = qmc.Sobol(arm.n, scramble=True, rng=np.random.default_rng(seed)).random(DRAWN)
    drawn = low + points * (high - low)
    clear = drawn[arm.is_clear(drawn)]
    if len(clear) == 0:
        raise none_clear(arm, drawn)
    clear = clear[np.argsort(arm.effort(clear), kind="stable")]
    # One third are the poses of least effort. One third have the largest curvature of the potential
    # energy, where the arm hangs. The others are distributed, so that the search covers several
    # local minima.
    third = STARTS // 3
    spread = clear[third :: max(1, len(clear) // third)][:third]
    return np.concatenate([clear[:third], _in_valleys(arm, clear[:LIGHT], third), spread])


def _in_valleys(arm: RestingArm, poses: FloatArray, count: int) -> FloatArray:
    """Return (≤ count, n) those `poses` (N, n) whose minimum curvature is largest."""
    least = np.array([curvatures(arm, q)[0][0] for q in poses])
    return poses[np.argsort(-least, kind="stable")[:count]]


def drawn_range(arm: RestingArm) -> tuple[FloatArray, FloatArray]:
    """Return the joint range (n,), (n,) that contains every pose at least one time.

    The range of a joint is at most one turn about 0.
    """
    centre = np.clip(0.0, arm.low + np.pi, np.maximum(arm.high - np.pi, arm.low + np.pi))
    centre = np.where(np.isfinite(centre), centre, 0.0)
    return np.maximum(arm.low, centre - np.pi), np.minimum(arm.high, centre + np.pi)


def none_clear(arm: RestingArm, looked_at: FloatArray) -> PlanError:
    """Return the error that reports the largest clearance of the tested poses (N, n)."""
    distances = [arm.closest(q) for q in looked_at[:256]]
    roomiest, (a, b) = max(distances)
    return PlanError(
        f"no tested pose has a clearance of {1e3 * arm.clearance_m:.0f} mm; the largest is "
        f"{1e3 * roomiest:.0f} mm, between {a} and {b}",
        hint="reduce --clearance-mm, or check the surroundings in the station file",
    )


def free_joints(arm: RestingArm, q: FloatArray) -> BoolArray:
    """Return an (n,) mask of joints that affect no torque, evaluated at `q` (N, n)."""
    slopes = np.array([arm.stiffness(pose) / arm.limit[:, None] for pose in q])
    return np.asarray(np.abs(slopes).max(axis=(0, 1)) < INDIFFERENT)


def turned(arm: RestingArm, q: FloatArray, free: BoolArray, wanted: FloatArray) -> FloatArray:
    """Return the pose `q` (n,) with its free joints at `wanted` (n,), if collision-free.

    A free joint keeps its angle if the changed pose is not collision-free.
    """
    for joint in np.flatnonzero(free):
        other = q.copy()
        other[joint] = np.clip(wanted[joint], arm.low[joint], arm.high[joint])
        q = other if arm.is_clear(other[None])[0] else q
    return q


def least_effort(arm: RestingArm, start: FloatArray) -> FloatArray:
    """Return the pose (n,) of minimum effort that a local search from `start` (n,) reaches."""
    return _search(arm, start, lambda q: _effort_cost(arm, q))


def nearest_within(
    arm: RestingArm, near: FloatArray, effort: float, starts: Iterable[FloatArray]
) -> list[FloatArray]:
    """Return the poses (n,) nearest to `near` with limited effort, one pose per start pose."""
    bound = {
        "type": "ineq",
        "fun": lambda q: arm.n * (100 * effort) ** 2 - _effort_cost(arm, q)[0],
        "jac": lambda q: -_effort_cost(arm, q)[1],
    }

    def cost(q: FloatArray) -> tuple[float, FloatArray]:
        return float(np.sum((q - near) ** 2)), 2.0 * (q - near)

    return [_search(arm, np.clip(start, arm.low, arm.high), cost, bound) for start in starts]


def _effort_cost(arm: RestingArm, q: FloatArray) -> tuple[float, FloatArray]:
    """Return the sum of the squared torque shares [squared percent], and its gradient."""
    torque, stiffness = arm.torque_and_stiffness(q)
    percent = 100.0 * torque / arm.limit
    slopes = 100.0 * stiffness / arm.limit[:, None]
    return float(percent @ percent), 2.0 * slopes.T @ percent


def _search(arm: RestingArm, start: FloatArray, cost: Cost, *constraints: Any) -> FloatArray:
    """Return the local optimum (n,) that SLSQP finds from `start` (n,)."""
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
    """Return the best pose with the safest outcome after a brake failure.

    The function returns None if the arm tips or falls in all poses.
    """
    safest = min(found, key=lambda pose: (ORDER.index(pose.fail.outcome), _rank(pose)))
    return safest if safest.fail.outcome in ("stays", "held") else None


def _add(chosen: list[RestPose], pose: RestPose, label: str, free: BoolArray) -> None:
    """Add a pose to the list, or only its label if the pose is already in the list."""
    for i, other in enumerate(chosen):
        if not _apart(pose.q, other.q, free):
            chosen[i] = replace(other, label=f"{other.label}, {label}")
            return
    chosen.append(replace(pose, label=label))


def _nearest(arm: RestingArm, near: FloatArray, found: Sequence[RestPose]) -> RestPose:
    """Return the pose of low effort nearest to `near`.

    The effort exceeds the minimum effort by at most `NEAR_SHARE`.
    """
    most = found[0].effort + NEAR_SHARE
    by_way = sorted(found, key=lambda pose: _far(pose.q, near))[:3]
    reached = nearest_within(arm, near, most, [near, *(pose.q for pose in by_way)])
    poses = [*found, *(described(arm, q, "") for q in reached)]
    cheap = [pose for pose in poses if pose.clear and pose.effort <= most * (1 + 1e-6)]
    return min(cheap, key=lambda pose: _far(pose.q, near))


def _far(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b))


def _apart(a: FloatArray, b: FloatArray, free: BoolArray) -> bool:
    """Return whether two poses differ, apart from full turns and free joints."""
    turn = np.remainder(a - b + np.pi, 2 * np.pi) - np.pi
    return bool(np.max(np.abs(turn[~free]), initial=0.0) > APART_RAD)


Outcome = Literal["stays", "held", "tips", "falls"]

BALANCED_SHARE = 0.005
"""Share of the torque limit below which a joint torque counts as zero."""

COUNTED = 0.5
"""Share of the dry friction of the model that is counted as holding torque."""

INDIFFERENT = 1e-3
"""Maximum change of torque per radian, as a share of the limits, along a direction that counts
as indifferent."""


@dataclass(frozen=True, slots=True, eq=False)
class BrakesFail:
    """Behavior of an arm after its brakes and drives have failed.

    Attributes:
        outcome: Behavior of the arm: `stays` (no torque, no unstable direction), `held` (only by
            dry friction), `tips` (no torque, but an unstable direction, and no friction known to
            hold the arm) or `falls`.
        balanced: Whether every torque is below `BALANCED_SHARE` of its limit.
        stable, unstable, indifferent: Numbers of independent stable, unstable and indifferent
            directions.
        way_down: (n,) steepest unstable direction, with largest entry 1; zeros if no direction is
            unstable.
        spare: (n,) counted dry friction minus torque [N·m]; NaN if the dry friction is unknown.
    """

    outcome: Outcome
    balanced: bool
    stable: int
    unstable: int
    indifferent: int
    way_down: FloatArray
    spare: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """Return the behavior as JSON data."""
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
    """Return the behavior of the arm at `q` (n,) after all brakes fail simultaneously."""
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
    """Return curvatures (n,) of the potential energy at `q` (n,), and directions (n, n).

    The curvatures are in ascending order.

    The joint angles are scaled by the torque limits, so that a curvature is the change of torque
    per radian as a share of the limit. The signs of the curvatures, and therefore the number of
    stable and unstable directions, do not depend on the scaling (Sylvester's law of inertia). The
    torques of independent regressions (eq. 15 of the static paper) possibly have no potential
    energy; in this case, the symmetric part of the torque derivative is used.
    """
    weight = 1.0 / np.sqrt(arm.limit)
    K = arm.stiffness(q)
    curvature, vectors = np.linalg.eigh(weight[:, None] * (0.5 * (K + K.T)) * weight)
    return curvature, weight[:, None] * vectors


STIFFNESS_STEP_RAD = 1e-4
"""Step with which the torque is differentiated by central differences [rad]."""

DISTANCE_STEP_RAD = 1e-6
"""Step with which distances are differentiated by forward differences [rad]; distances are not
differentiable everywhere."""

TOLERANCE_RAD = 1e-9

TOLERANCE_M = 1e-7


class Distances(Protocol):
    """Part of a collision model (`hil.dynamics.CollisionModel`) that the search requires."""

    def distances(self, q: FloatArray) -> FloatArray:
        """Return the distances [m] (R, N) at `q` (N, n); negative if bodies overlap."""

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Return the minimum distance [m] at `q` (n,), and the names of its two bodies."""


@dataclass(frozen=True, eq=False)
class RestingArm:
    """Static arm whose brakes are applied.

    Attributes:
        joint_names: Names of the n joints.
        gravity: Function that returns the holding torques (N, n) [N·m] of arm and payload at joint
            positions (N, n).
        limit: (n,) torque limits [N·m], with which all torques are scaled.
        low, high: (n,) limits of the joint range without the margin [rad]; infinite for continuous
            joints.
        friction: (n,) dry friction [N·m]; None if unknown.
        around: Function for the distances of the arm to itself and its surroundings; None if
            distances are not checked.
        clearance_m: Required clearance [m].

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
            self.low >= self.high, "no position is within the limits of", "reduce the margin"
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
        """Return the torque shares (N, n) of the limits, with sign, at `q` (N, n)."""
        share: FloatArray = self.gravity(q) / self.limit
        return share

    def effort(self, q: FloatArray) -> FloatArray:
        """Return the root mean square (N,) of the torque shares, which the search minimizes."""
        return np.asarray(np.sqrt(np.mean(self.share(q) ** 2, axis=1)))

    def stiffness(self, q: FloatArray) -> FloatArray:
        """Return the change (n, n) of the gravity torques per joint angle [N·m/rad] at `q` (n,).

        The derivative of the gravity torques is the Hessian of the potential energy, if the torques
        have a potential energy.
        """
        return self.torque_and_stiffness(q)[1]

    def torque_and_stiffness(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return torques (n,) [N·m] and `stiffness` (n, n) at `q` (n,) from one model call."""
        step = STIFFNESS_STEP_RAD * np.eye(self.n)
        torque = self.gravity(np.concatenate([q[None], q + step, q - step]))
        change = (torque[1 : self.n + 1] - torque[self.n + 1 :]) / (2 * STIFFNESS_STEP_RAD)
        return torque[0], change.T

    def room(self, q: FloatArray) -> FloatArray:
        """Return distances minus clearance (R,) [m] at `q` (n,); empty if not checked."""
        return self._rooms(q[None])[:, 0]

    def room_slopes(self, q: FloatArray) -> FloatArray:
        """Return the derivative (R, n) of `room` at `q` (n,)."""
        moved = np.concatenate([q[None], q + DISTANCE_STEP_RAD * np.eye(self.n)])
        rooms = self._rooms(moved)
        slopes: FloatArray = (rooms[:, 1:] - rooms[:, :1]) / DISTANCE_STEP_RAD
        return slopes

    def is_clear(self, q: FloatArray) -> BoolArray:
        """Return whether each pose of `q` (N, n) satisfies joint limits and clearance, (N,)."""
        low, high = self.low - TOLERANCE_RAD, self.high + TOLERANCE_RAD
        inside = np.all((q >= low) & (q <= high), axis=1)
        least = self._rooms(q).min(axis=0, initial=np.inf)
        return np.asarray(inside & (least >= -TOLERANCE_M))

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Return the minimum distance [m] at `q` (n,) and its bodies; infinite if not checked."""
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
