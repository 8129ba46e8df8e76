"""Checks of a spec and of a plan against the limits of an arm.

`excesses` reports the values of a spec that the arm cannot execute, before a plan exists. A plan is
refused if a set-point is beyond a limit (`margins_of`), or if its motion would trip an interlock of
the spec (`interlock_margins`). The margins of an accepted plan are its smallest distances to the
limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import BoolArray, FloatArray, KeyPath, PlanError
from hil.dynamics import (
    FlangeSpace,
    Plane,
    RobotModel,
    base_parameters,
    conditioning,
    smallest_along_paths,
)
from hil.excitation import Distances, Motion, Workspace, outside
from hil.planning.plan import Extremes, LoadStep, Step, extremes_of
from hil.spec import (
    ClearanceInterlock,
    Dwell,
    Excess,
    ExperimentSpec,
    Fourier,
    Interlock,
    WorkspaceInterlock,
)

BodySize = tuple[float, float]
"""Length and radius of a body along the flange axis [m]."""

SOME_POSES = 16384
"""Number of random poses that the workspace check tries.

At least one of these random poses must lie inside the workspace, because planning needs several
valid poses among the same number of random poses.
"""


def excesses(
    spec: ExperimentSpec, arm: ArmDescription, robot_hz: float, clearance_m: float
) -> list[Excess]:
    """Return one entry for every value of a spec that the robot cannot execute.

    Args:
        spec: Spec of the experiment.
        arm: Description of the arm with its limits.
        robot_hz: Rate at which the robot accepts set-points and reports its state [Hz].
        clearance_m: Minimum distance to all obstacles [m], a value of the station.
    """
    ranges = [*_beyond_range(spec.excitation, arm), *_reference(spec, arm)]
    return [
        *_other_rate(spec, robot_hz),
        *_too_fast(spec.excitation, arm),
        *ranges,
        *([] if ranges else _confined(spec, arm, clearance_m)),
        *(
            Excess(
                ("loads", i, "mass_kg"),
                f"{load.mass_kg:g} kg exceeds the rated payload of the {arm.name}, "
                f"{arm.payload_max_kg:g} kg",
            )
            for i, load in enumerate(spec.loads)
            if load.mass_kg > arm.payload_max_kg
        ),
    ]


def _beyond_range(excitation: Dwell | Fourier, arm: ArmDescription) -> Iterator[Excess]:
    if excitation.range_deg is None:
        return
    if len(excitation.range_deg) != arm.n_joints:
        yield Excess(
            ("excitation", "range_deg"),
            f"{len(excitation.range_deg)} ranges, but the {arm.name} has {arm.n_joints} joints",
        )
        return
    for i, (low, high) in enumerate(excitation.range_deg):
        yield from _outside(("excitation", "range_deg", i), (low, high), i, arm)


def _outside(
    path: KeyPath, angles: Sequence[float], i: int, arm: ArmDescription
) -> Iterator[Excess]:
    low, high = float(np.degrees(arm.q_min[i])), float(np.degrees(arm.q_max[i]))
    for angle in angles:
        if not low - TOLERANCE <= angle <= high + TOLERANCE:
            yield Excess(
                path,
                f"{angle:g}° is outside the range of {arm.joint_names[i]}, {low:g}° to {high:g}°",
            )


def _reference(spec: ExperimentSpec, arm: ArmDescription) -> Iterator[Excess]:
    q_deg = spec.reference.q_deg
    if q_deg is None:
        return
    if len(q_deg) != arm.n_joints:
        yield Excess(
            ("reference", "q_deg"),
            f"{len(q_deg)} angles, but the {arm.name} has {arm.n_joints} joints",
        )
        return
    for i, angle in enumerate(q_deg):
        yield from _outside(("reference", "q_deg", i), (angle,), i, arm)


def _other_rate(spec: ExperimentSpec, robot_hz: float) -> Iterator[Excess]:
    asked = spec.record.rate_hz
    if asked is not None and abs(asked - robot_hz) > 1e-6 * robot_hz:
        yield Excess(
            ("record", "rate_hz"),
            f"{asked:g} Hz, but the robot runs at {robot_hz:g} Hz: "
            "omit this key, or set the rate in the station's options",
        )


def _too_fast(excitation: Dwell | Fourier, arm: ArmDescription) -> Iterator[Excess]:
    for key, asked, unit, limits in (
        ("max_velocity_deg_s", excitation.max_velocity_deg_s, "°/s", arm.qd_max),
        ("max_acceleration_deg_s2", excitation.max_acceleration_deg_s2, "°/s²", arm.qdd_max),
    ):
        weakest = int(np.argmin(limits))
        most = float(np.degrees(limits[weakest]))
        if asked > most * (1 + TOLERANCE):
            yield Excess(
                ("excitation", key),
                f"{asked:g} {unit} exceeds the limit of {arm.joint_names[weakest]}, "
                f"{most:g} {unit}",
            )


def _confined(spec: ExperimentSpec, arm: ArmDescription, clearance_m: float) -> Iterator[Excess]:
    """Yield the values of a spec that conflict with its workspace interlocks, before planning."""
    space = declared_space(spec.interlocks, arm, [load.size_m for load in spec.loads])
    if space is None:
        return
    if narrow := list(_too_narrow(spec.interlocks, clearance_m)):
        yield from narrow
        return
    if getattr(spec.excitation, "file", None) is None:  # else its poses are known, and looked at
        yield from _unreached(spec.excitation, arm, space, clearance_m)
    if spec.reference.q_deg is not None and (
        complaint := outside(space, np.radians(np.array(spec.reference.q_deg)), clearance_m)
    ):
        yield Excess(("reference", "q_deg"), complaint)


def _too_narrow(interlocks: Sequence[Interlock], clearance_m: float) -> Iterator[Excess]:
    """Yield an entry for each axis on which the workspace boxes together leave no free space."""
    boxes = [
        (number, entry)
        for number, entry in enumerate(interlocks)
        if isinstance(entry, WorkspaceInterlock) and entry.enabled
    ]
    for i, axis in enumerate("xyz"):
        lows = [(box.min_m[i], number) for number, box in boxes if box.min_m is not None]
        highs = [(box.max_m[i], number) for number, box in boxes if box.max_m is not None]
        if not lows or not highs:
            continue
        (low, _), (high, number) = max(lows), min(highs)
        if high - low <= 2 * clearance_m:
            yield Excess(
                ("interlocks", number, "max_m", i),
                f"leaves {1e3 * (high - low):.0f} mm to min_m on {axis}, but the station's "
                f"clearance_m requires {1e3 * clearance_m:.0f} mm on each side",
            )


def _unreached(
    excitation: Dwell | Fourier, arm: ArmDescription, space: Distances, clearance_m: float
) -> Iterator[Excess]:
    """Yield an entry if none of many random poses lies inside the workspace."""
    low, high = draw_range(excitation, arm)
    some = low + np.random.default_rng(0).uniform(size=(SOME_POSES, arm.n_joints)) * (high - low)
    nearest = some[int(space.distances(some).min(axis=0).argmax())]
    if complaint := outside(space, nearest, clearance_m):
        yield Excess(
            ("interlocks",),
            f"none of {SOME_POSES} poses from the joint ranges is inside the workspace; closest "
            f"rejected pose: {complaint}",
        )


def draw_range(excitation: Dwell | Fourier, arm: ArmDescription) -> tuple[FloatArray, FloatArray]:
    """Return the minimum and maximum joint positions (n,) from which an excitation draws [rad]."""
    if excitation.range_deg is None:
        return arm.excite_min, arm.excite_max
    low, high = np.radians(np.array(excitation.range_deg)).T
    return low, high


TOLERANCE = 1e-9
"""Amount by which a set-point may exceed a limit because of rounding."""

MOST_PROBLEMS = 20


def margins_of(
    steps: Sequence[Step],
    loads: Sequence[LoadStep],
    arm: ArmDescription,
    gravity: tuple[float, float, float],
    workspace: Workspace,
) -> dict[str, float]:
    """Return the smallest margin to each limit over all joints and set-points, all ≥ 0.

    ======================== ==========================================================
    position_rad             to the robot's position limits
    velocity_rad_s           to the spec's `max_velocity_deg_s` or the robot's limit
    acceleration_rad_s2      to the spec's `max_acceleration_deg_s2` or the robot's limit
    robot_velocity_rad_s     to the robot's velocity limits alone
    robot_acceleration_rad_s2  to the robot's acceleration limits alone
    effort_nm                to the robot's torque limits: nominal rigid body, no friction
    clearance_m              smallest distance to anything, itself and the payload included;
                             at least the station's `clearance_m`
    ======================== ==========================================================

    Raises:
        PlanError: A set-point exceeds a limit; the message lists the affected steps.
    """
    motions = [step.motion for step in steps if step.motion is not None]
    distances = workspace.clearances(motions)
    _require_clear(steps, workspace.keep_clear(motions), distances, workspace.clearance_m)
    goes = extremes_of(motions, workspace.rate_hz)
    margins = _kinematic(goes, arm, workspace)
    payloads = [load.payload for load in loads]
    margins["effort_nm"] = effort_margin(arm, gravity, payloads, motions, workspace.rate_hz)
    _require_positive(margins)
    margins["clearance_m"] = float(distances.min())
    return {name: max(value, 0.0) for name, value in margins.items()}


def _require_clear(
    steps: Sequence[Step], kept: BoolArray, distances: FloatArray, clearance_m: float
) -> None:
    moving = [step for step in steps if step.motion is not None]
    close = [
        f"step {step.index} ({step.kind}) comes within {1e3 * distance:.1f} mm of an obstacle, "
        f"{1e3 * clearance_m:.1f} mm are required"
        for step, clear, distance in zip(moving, kept, distances, strict=True)
        if not clear
    ]
    if close:
        more = [f"… and {len(close) - MOST_PROBLEMS} more"] if len(close) > MOST_PROBLEMS else []
        raise PlanError(
            "\n".join(close[:MOST_PROBLEMS] + more),
            hint="check that the station's surroundings are described correctly",
        )


def _kinematic(goes: Extremes, arm: ArmDescription, workspace: Workspace) -> dict[str, float]:
    velocity = float((arm.qd_max - goes.qd_max).min())
    acceleration = float((arm.qdd_max - goes.qdd_max).min())
    return {
        "position_rad": float(min((goes.q_min - arm.q_min).min(), (arm.q_max - goes.q_max).min())),
        "velocity_rad_s": min(velocity, workspace.velocity - float(goes.qd_max.max())),
        "acceleration_rad_s2": min(
            acceleration, workspace.acceleration - float(goes.qdd_max.max())
        ),
        "robot_velocity_rad_s": velocity,
        "robot_acceleration_rad_s2": acceleration,
    }


def _require_positive(margins: dict[str, float]) -> None:
    negative = [f"{name}: {value:.4g}" for name, value in margins.items() if value < -TOLERANCE]
    if negative:
        raise PlanError(
            "the motion exceeds its limits; negative margins:\n" + "\n".join(negative),
            hint="lower excitation.max_velocity_deg_s and excitation.max_acceleration_deg_s2, "
            "or use a lighter load",
        )


def flange_space(
    arm: ArmDescription, space: WorkspaceInterlock, sizes: Sequence[BodySize | None]
) -> FlangeSpace:
    """Return the distances of the flange and of the longest load's tip to the faces of a workspace.

    A single tip represents all loads, as a single body represents all loads in the collision check.
    For a load of unknown size, only the position of the flange is checked.

    Args:
        arm: Description of the arm.
        space: Box and planes of the workspace.
        sizes: Length and radius of each load's body [m]; None for a load of unknown size.
    """
    return FlangeSpace(arm, _faces(space), _tip_m(sizes))


def _faces(space: WorkspaceInterlock) -> list[Plane]:
    faces = [Plane(wall.point_m, wall.normal, wall.name) for wall in space.planes]
    for key, corner, inwards in (("min_m", space.min_m, 1.0), ("max_m", space.max_m, -1.0)):
        if corner is not None:
            faces += [
                Plane(corner, (inwards * (i == 0), inwards * (i == 1), inwards * (i == 2)), name)
                for i, name in enumerate(f"{axis} of {key}" for axis in "xyz")
            ]
    return faces


def _tip_m(sizes: Sequence[BodySize | None]) -> float:
    """Return the distance by which the longest load extends beyond the flange [m]."""
    return max((size[0] for size in sizes if size is not None), default=0.0)


def declared_space(
    interlocks: Sequence[Interlock], arm: ArmDescription, sizes: Sequence[BodySize | None]
) -> FlangeSpace | None:
    """Return the space that all workspace interlocks of a spec leave to the flange.

    The return value is None if the spec has no workspace interlock. Each face of the space has a
    name that contains its interlock: `x of max_m (interlocks.1)`.

    Args:
        interlocks: Interlocks of the spec.
        arm: Description of the arm.
        sizes: Length and radius of each load's body [m]; None for a load of unknown size.
    """
    faces = [
        replace(face, name=f"{face.name} (interlocks.{number})")
        for number, interlock in enumerate(interlocks)
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled
        for face in _faces(interlock)
    ]
    return FlangeSpace(arm, faces, _tip_m(sizes)) if faces else None


def interlock_margins(
    interlocks: Sequence[Interlock],
    arm: ArmDescription,
    sizes: Sequence[BodySize | None],
    steps: Sequence[Step],
    rate_hz: float,
    clearance_m: float,
) -> dict[str, float]:
    """Return the smallest distances of a plan to the limits of its interlocks.

    The key `workspace_m` contains the smallest distance of the flange to a face of the workspace
    [m]. The returned mapping is empty if the spec has no workspace interlock.

    Args:
        interlocks: Interlocks of the spec.
        arm: Description of the arm.
        sizes: Length and radius of each load's body [m]; None for a load of unknown size.
        steps: Steps of the plan.
        rate_hz: Rate at which the motions are sampled [Hz].
        clearance_m: Smallest distance of the planned motions to any obstacle [m].

    Raises:
        PlanError: The planned motion would trip an interlock; the message lists all such
            interlocks.
    """
    moving = [step for step in steps if step.motion is not None]
    margins: list[float] = []
    problems: list[str] = []
    for number, interlock in enumerate(interlocks):
        problem = ""
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled:
            space = flange_space(arm, interlock, sizes)
            least, problem = _least(space, moving, rate_hz)
            margins.append(least)
        elif isinstance(interlock, ClearanceInterlock) and interlock.enabled:
            problem = _too_close(interlock, clearance_m)
        if problem:
            problems.append(f"interlocks.{number} ({interlock.kind}): {problem}")
    if problems:
        raise PlanError(
            "\n".join(problems),
            hint="change these entries, or restrict the motion by excitation.range_deg or by the "
            "poses of excitation.file",
        )
    return {"workspace_m": min(margins)} if margins else {}


def _least(space: FlangeSpace, steps: Sequence[Step], rate_hz: float) -> tuple[float, str]:
    """Return the smallest distance to a face of the workspace during the moving steps [m].

    If the smallest distance is negative, the second value is a text that describes the violation.
    """
    paths = [step.motion.sample(rate_hz).q for step in steps if step.motion is not None]
    found, samples = smallest_along_paths(paths, space.distances, space.reach)
    at = int(found.argmin())
    least = float(found[at])
    if least >= 0:
        return least, ""
    point, face = space.names[int(space.distances(paths[at][[samples[at]]])[:, 0].argmin())]
    place = f"step {steps[at].index} ({steps[at].kind})"
    return least, f"{place} moves the {point} {-1e3 * least:.1f} mm beyond {face}"


def _too_close(interlock: ClearanceInterlock, clearance_m: float) -> str:
    if interlock.least_m is None or interlock.least_m < clearance_m:
        return ""
    return (
        f"least_m is {interlock.least_m:g} m, but the smallest distance of the plan to an "
        f"obstacle is {clearance_m:.4f} m"
    )


MOST_ROWS = 1500
"""Maximum number of samples in the regressor for the condition number.

More samples than this maximum change only the third digit of the condition number.
"""

EFFORT_ROWS = 10_000
Score = Callable[[FloatArray, FloatArray, FloatArray], float]


def condition_score(arm: ArmDescription, gravity: Sequence[float], *, at_rest: bool) -> Score:
    """Return a function that computes the condition number of the base regressor.

    The returned function has the arguments q, qd and qdd, each (N, n), and returns the
    column-scaled condition number.

    Args:
        arm: Description of the arm.
        gravity: (3,) gravity vector in the base frame [m/s²].
        at_rest: Whether only the parameters that gravity excites are included; velocities and
            accelerations are then ignored.
    """
    model = RobotModel.from_arm(arm.name, gravity=gravity)
    base = base_parameters(model, gravity_only=at_rest)

    def score(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> float:
        W = model.gravity_regressor(q) if at_rest else model.regressor(q, qd, qdd)
        if len(W) < base.rank:
            return float("inf")
        scaled = conditioning(base.reduce(W)).scaled
        return scaled if scaled < 1e12 else float("inf")

    return score


def condition_number(score: Score, measured: Sequence[Motion], rate_hz: float) -> float:
    """Return the `score` of evenly thinned samples of the measuring motions."""
    return score(*_thinned(measured, rate_hz, MOST_ROWS))


def _thinned(
    motions: Sequence[Motion], rate_hz: float, most_rows: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return q, qd and qdd at every k-th sample of the distinct motions.

    The divisor k is chosen for at most about `most_rows` samples.
    """
    samples = [motion.sample(rate_hz) for motion in dict.fromkeys(motions)]
    every = max(1, sum(map(len, samples)) // most_rows)
    columns = ([getattr(s, name) for s in samples] for name in ("q", "qd", "qdd"))
    q, qd, qdd = (np.concatenate(column)[::every] for column in columns)
    return q, qd, qdd


def effort_margin(
    arm: ArmDescription,
    gravity: Sequence[float],
    loads: Sequence[Payload],
    motions: Sequence[Motion],
    rate_hz: float,
) -> float:
    """Return the smallest distance of a joint torque to its limit [N·m].

    The torques are computed for the nominal rigid body with each load, without friction. The
    returned distance is negative if a torque exceeds its limit.
    """
    model = RobotModel.from_arm(arm.name, gravity=gravity)
    q, qd, qdd = _thinned(motions, rate_hz, EFFORT_ROWS)
    return min(
        float(
            (arm.effort_max - np.abs(model.with_payload(load).inverse_dynamics(q, qd, qdd))).min()
        )
        for load in dict.fromkeys(loads)
    )
