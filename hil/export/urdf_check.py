"""Whether a URDF, read back, says what the model says: by the model's own predictions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.core import FitError, FloatArray
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator
from hil.export.agreement import FAULT, scale_of
from hil.export.golden import RATE_HZ, SAMPLES, motion
from hil.export.identified_parameters import (
    SIGN_WIDTH,
    IdentifiedParameters,
    friction_asked,
    rigid_asked,
)

EXACT = 1e-9
"""Largest miss where links have the model's parameters, as a share of a joint's largest torque."""

NEAR = 0.05
"""The same where links only come near, and for friction beyond what Coulomb's and viscous leave."""

HZ = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Miss:
    """Of the file, as shares of each joint's largest torque of the kind, over all motions asked.

    Attributes:
        rigid: (n,) the larger one of gravity's and of gravity and inertia together.
        friction: (n,) friction and damping against the model's friction less a constant.
        avoidable: (n,) by how much the best Coulomb and viscous friction misses less.
    """

    rigid: FloatArray
    friction: FloatArray
    avoidable: FloatArray


def missed(path: Path, model: RobotEstimator) -> Miss:
    """What the file misses, read back, of `model.predict`."""
    robot = model.robot_
    again = RobotModel.from_urdf(
        path, gravity=robot.gravity_vector.tolist(), flange=str(robot.to_dict()["flange"])
    )
    q, qd, qdd = motion(robot, SAMPLES, RATE_HZ)
    gravity, whole = rigid_asked(model, (q, qd, qdd))
    still = np.zeros_like(q)
    rigid = np.maximum(
        share(again.inverse_dynamics(q, still, still), gravity, gravity, whole),
        share(again.inverse_dynamics(q, qd, qdd), whole, gravity, whole),
    )
    friction, avoidable = _friction_missed(path, model)
    return Miss(rigid, friction, avoidable)


def share(found: FloatArray, wanted: FloatArray, *of: FloatArray) -> FloatArray:
    """(n,) largest difference as a share of each joint's largest; NaN counts as endless."""
    off: FloatArray = np.abs(found - wanted).max(axis=0) / scale_of(*of)
    return np.where(np.isnan(off), np.inf, off)


def require_near(miss: Miss, found: IdentifiedParameters, names: tuple[str, ...]) -> None:
    """Refuse what is not as near as it can be.

    Raises:
        FitError: Links that have the model's parameters miss its torques, others miss them by more
            than `NEAR`, or there is friction that comes nearer to the model's.
    """
    if found.exact and not np.all(miss.rigid <= EXACT):
        raise FitError(
            "the URDF read back misses the model's gravity and inertia by "
            f"{miss.rigid.max():.1g} of a joint's largest torque",
            hint=FAULT,
        )
    if not np.all(miss.avoidable <= NEAR):
        raise FitError(
            "friction and damping of the URDF read back are not those nearest to the model's: off "
            f"by {miss.friction.max():.1g} of a joint's largest friction",
            hint=FAULT,
        )
    if not np.all(miss.rigid <= NEAR):
        far = ", ".join(
            f"{name} {one:.0%}" for name, one in zip(names, miss.rigid, strict=True) if one > NEAR
        )
        raise FitError(
            "no links that can exist come near the model's gravity and inertia; of a joint's "
            f"largest torque they miss: {far}",
            hint="fit rigid-lmi or rigid-hysteresis, which know links that can exist, or say "
            "--unchecked to have these",
        )


def words(miss: Miss, found: IdentifiedParameters) -> str:
    """How well the file agrees, joint by joint where it does not."""
    if found.exact:
        rigid = f"largest difference {miss.rigid.max():.1e}"
    else:
        rigid = f"missed by {_percent(miss.rigid)}"
    return (
        f"read back, against the model: gravity and inertia {rigid} of each joint's largest "
        f"torque; friction missed by {_percent(miss.friction)} of its largest"
    )


def _percent(shares: FloatArray) -> str:
    return ", ".join(f"{100 * one:.1f}" for one in shares) + " %"


def _friction_missed(path: Path, model: RobotEstimator) -> tuple[FloatArray, FloatArray]:
    qd, wanted = friction_asked(model, HZ)
    sign = np.tanh(qd / SIGN_WIDTH)
    coulomb, viscous = _dynamics(path, model.joint_names_)
    largest = scale_of(wanted)
    left, least = np.empty((2, len(coulomb)))
    for j in range(len(coulomb)):
        # URDF has no word for a constant, so that is nobody's fault.
        rest = wanted[:, j] - coulomb[j] * sign[:, j] - viscous[j] * qd[:, j]
        left[j] = np.std(rest) / largest[j]
        terms = np.column_stack([sign[:, j], qd[:, j], np.ones(len(qd))])
        best = np.linalg.lstsq(terms, wanted[:, j], rcond=None)[0]
        best[:2] = np.maximum(best[:2], 0.0)
        least[j] = np.std(wanted[:, j] - terms @ best) / largest[j]
    return left, left - least


def _dynamics(path: Path, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Coulomb friction and damping (n,) as URDF's words stand in the file."""
    joints = {one.get("name"): one for one in ET.parse(path).getroot().findall("joint")}  # noqa: S314
    told = [joints[name].find("dynamics") for name in names]
    return tuple(  # type: ignore[return-value]
        np.array([np.nan if one is None else float(one.get(word, "nan")) for one in told])
        for word in ("friction", "damping")
    )
