"""Conversion of a URDF to an arm description in DH convention, and comparison of the two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from hil.core import FloatArray, SpecError
from hil.dynamics.build import joint_geometry, model_from_urdf, model_of_dh

PARALLEL = 1e-6
"""Sine of the angle below which two joint axes are treated as parallel."""
ON_AXIS_M = 1e-6
AGREE_NM = 1e-6
"""Maximum permitted difference of the torques of URDF and arm description [N·m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """Content of a URDF, converted to standard (distal) DH frames and SI units.

    Attributes:
        joint_names, link_names: Names of the n joints and the n links.
        dh: (n, 4) DH parameters, one row per joint: a [m], alpha [rad], d [m], theta offset [rad].
        q_min, q_max: (n,) position limits [rad]; infinite for continuous joints.
        qd_max, effort_max: (n,) limits of velocity [rad/s] and torque [N·m]; 0 if the URDF contains
            no limit.
        mass, com, inertia: (n,) masses, (n, 3) centres of mass in the DH frames of the links, and
            (n, 3, 3) inertias about the centres of mass.
        axes: (n, 2, 3) line of each link from the origin of its joint to the origin of the next
            joint, in the DH frame of the link [m].
        rotor_inertia: (n,) values of the attribute `armature` [kg·m²], which arm descriptions do
            not contain; 0 if missing.
    """

    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    dh: FloatArray
    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    effort_max: FloatArray
    mass: FloatArray
    com: FloatArray
    inertia: FloatArray
    axes: FloatArray
    rotor_inertia: FloatArray


def described(path: Path) -> Described:
    """Return the arm described by a URDF in DH convention.

    Raises:
        SpecError: The file cannot be used, a joint is prismatic, a link has no mass, or the first
            joint axis is not the z axis of the base.
    """
    model, flange = model_from_urdf(path)
    geometry = joint_geometry(model)
    if not geometry.turns.all():
        raise SpecError(
            f"{path}: the arm has a prismatic joint, but the DH description supports "
            "revolute joints only"
        )
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    pin.updateFramePlacements(model, data)
    places = list(data.oMi)[1:]
    axes = np.array([p.rotation @ axis for p, axis in zip(places, geometry.axis, strict=True)])
    origins = np.array([place.translation for place in places])
    _require_base(path, axes[0], origins[0])
    frames, dh = _frames(axes, origins, data.oMf[flange])
    bodies = [
        place.act(inertia) for place, inertia in zip(places, list(model.inertias)[1:], strict=True)
    ]
    found = Described(
        joint_names=tuple(map(str, model.names))[1:],
        link_names=_links(model),
        dh=dh,
        q_min=np.array(model.lowerPositionLimit),
        q_max=np.array(model.upperPositionLimit),
        qd_max=_finite_limits(model.velocityLimit),
        effort_max=_finite_limits(model.effortLimit),
        mass=np.array([body.mass for body in bodies]),
        com=np.array([_within(f, b.lever) for f, b in zip(frames, bodies, strict=True)]),
        inertia=np.array(
            [f[:3, :3].T @ b.inertia @ f[:3, :3] for f, b in zip(frames, bodies, strict=True)]
        ),
        axes=_segments(frames, np.vstack([origins, data.oMf[flange].translation])),
        rotor_inertia=np.array(model.armature),
    )
    model.armature = np.zeros(model.nv)  # the comparison below covers only the links
    _require_bodies(path, found)
    _compare(path, model, found)
    return found


def _within(frame: FloatArray, point: FloatArray) -> FloatArray:
    """Return a point (3,) of the base frame, expressed in a frame (4, 4)."""
    return np.asarray(frame[:3, :3].T @ (point - frame[:3, 3]))


def _finite_limits(limits: FloatArray) -> FloatArray:
    """Return joint limits in which missing (infinite) limits are 0."""
    return np.where(np.isfinite(limits) & (np.array(limits) < 1e6), limits, 0.0)


def _links(model: pin.Model) -> tuple[str, ...]:
    """Return the name of the first link that is attached to each joint."""
    names: dict[int, str] = {}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            names.setdefault(frame.parentJoint, str(frame.name))
    return tuple(names.get(joint, f"link {joint}") for joint in range(1, model.njoints))


def _require_base(path: Path, axis: FloatArray, origin: FloatArray) -> None:
    if axis[2] < 1 - PARALLEL or np.hypot(*origin[:2]) > ON_AXIS_M:
        raise SpecError(
            f"{path}: the axis of the first joint is {_vector(axis)} through {_vector(origin)}, "
            "but must be the z axis of the base frame",
            hint="move the first link's frame in the URDF so that its z axis is the axis of the "
            "first joint",
        )


def _vector(values: FloatArray) -> str:
    return "(" + ", ".join(f"{round(value, 6) + 0.0:g}" for value in values) + ")"


def _require_bodies(path: Path, found: Described) -> None:
    empty = [name for name, mass in zip(found.link_names, found.mass, strict=True) if mass <= 0]
    if empty:
        raise SpecError(
            f"{path}: the mass of {', '.join(empty)} is zero, but a simulation needs masses "
            "above zero",
            hint="give every link an <inertial>; a rough estimate is sufficient as a start",
        )
    least, *_, most = np.linalg.eigvalsh(found.inertia).T
    odd = [found.link_names[j] for j in np.flatnonzero(least < -PARALLEL * np.abs(most))]
    if odd:
        raise SpecError(
            f"{path}: the inertia of {', '.join(odd)} is not physically possible",
            hint="correct its <inertia>: ixx, iyy and izz must be above 0, the others smaller",
        )


def _frames(
    axes: FloatArray, origins: FloatArray, flange: pin.SE3
) -> tuple[list[FloatArray], FloatArray]:
    """Return the DH frames 1…n (4×4) at q = 0, and the DH parameters (n, 4)."""
    frame = np.eye(4)
    frames, rows = [], []
    for i in range(len(axes)):
        last = i + 1 == len(axes)
        after = _flange(frame, flange) if last else _next(frame, axes[i + 1], origins[i + 1])
        rows.append(_row(frame, after))
        frames.append(after)
        frame = after
    return frames, np.array(rows)


def _next(frame: FloatArray, axis: FloatArray, point: FloatArray) -> FloatArray:
    """Return the frame with z along the next axis and x along the common normal of both axes."""
    z, x_before, origin = frame[:3, 2], frame[:3, 0], frame[:3, 3]
    normal = np.cross(z, axis)
    across = point - origin - z * (z @ (point - origin))
    if np.linalg.norm(normal) > PARALLEL:
        x = normal / np.linalg.norm(normal)
        # Points of both axes at the foot of the normal: origin + s z + a x = point + t axis.
        _, a, t = np.linalg.solve(np.column_stack([z, x, -axis]), point - origin)
        foot = point + t * axis
        x = x if a > ON_AXIS_M or (abs(a) <= ON_AXIS_M and x @ x_before >= 0) else -x
    elif np.linalg.norm(across) > ON_AXIS_M:
        x = across / np.linalg.norm(across)
        foot = origin + across
    else:
        x, foot = x_before, origin
    return _frame(x, axis, foot)


def _flange(frame: FloatArray, flange: pin.SE3) -> FloatArray:
    """Return the flange frame if its z axis is the last joint axis, else a frame on that axis."""
    z, x_before, origin = frame[:3, 2], frame[:3, 0], frame[:3, 3]
    along = z * (z @ (flange.translation - origin))
    is_it = flange.rotation[:, 2] @ z > 1 - PARALLEL
    x = flange.rotation[:, 0] if is_it else x_before
    return _frame(x, z, origin + along)


def _frame(x: FloatArray, z: FloatArray, origin: FloatArray) -> FloatArray:
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, origin
    return frame


def _row(before: FloatArray, after: FloatArray) -> list[float]:
    """Return the DH parameters a, alpha, d, theta of the transformation between two frames."""
    step = np.linalg.inv(before) @ after
    theta = np.arctan2(step[1, 0], step[0, 0])
    alpha = np.arctan2(step[2, 1], step[2, 2])
    a = step[0, 3] * np.cos(theta) + step[1, 3] * np.sin(theta)
    return [float(a), float(alpha), float(step[2, 3]), float(theta)]


def _segments(frames: list[FloatArray], points: FloatArray) -> FloatArray:
    return np.array(
        [[_within(frame, end) for end in points[i : i + 2]] for i, frame in enumerate(frames)]
    )


def _compare(path: Path, model: pin.Model, found: Described) -> None:
    """Raise if the torques of URDF and arm description differ at random states."""
    again = model_of_dh(found.dh, found.mass, found.com, found.inertia)
    rng = np.random.default_rng(0)
    one, two = model.createData(), again.createData()
    for _ in range(8):
        state = rng.uniform(-2, 2, (3, len(found.mass)))
        miss = np.abs(pin.rnea(model, one, *state) - pin.rnea(again, two, *state)).max()
        if not miss < AGREE_NM:
            raise SpecError(
                f"{path}: the description in DH convention does not reproduce the torques of the "
                f"URDF (difference {miss:.3g} N·m)",
                hint="check that the axes are those of a serial arm; fixed links are merged",
            )
