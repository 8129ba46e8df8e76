"""What a fitted model says about the arm, as parameters of bodies that can exist.

Some estimators carry such parameters (`inertial_`). Others know base parameters only, or none by
name; then their rigid torques at sampled motions are reproduced by physically consistent links
nearest to the nominal ones (`hil.estimators.consistent`). Where links that can exist have the
model's base parameters, these come out exactly, and what torques do not show is all that is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FitError, FloatArray
from hil.data import Prediction
from hil.dynamics import BaseParameters, base_parameters, friction_terms, is_consistent
from hil.estimators import InertialBounds, RobotEstimator, consistent_least_squares, motion_of

SAMPLES = 400
SPEED_RAD_S = 1.0
ACCELERATION_RAD_S2 = 3.0
"""Motions at which a model is asked for its torques: what an arm does in an excitation."""

REACH_RAD = np.pi
"""Range of joints without limits."""

SMALLEST_SHARE = 1e-3
"""Torques are matched to this share of a joint's largest one; exactly where links allow."""

RIGID_SHARE = 1e-6
"""What a rigid body may leave of a model's rigid torques, as a share of the largest."""

RIGID = ("gravity", "inertia", "coriolis")
"""Parts of a prediction that bodies make."""

FRICTION_S, FRICTION_HZ = 60.0, 1000.0
SIGN_WIDTH = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedParameters:
    """An arm as bodies.

    Attributes:
        inertial: (11n,) in the order of `RobotModel.parameters(rotor=True)`, a body each.
        coulomb: (n,) friction that does not depend on speed [N·m], not below 0.
        viscous: (n,) friction per speed [N·m·s/rad], not below 0.
        mismatch: (n,) RMS of their torque less the model's rigid one over sampled motions [N·m].
        own: Whether the model itself has them.
        exact: Whether they have to make the model's torques: its own, or those of a rigid body
            whose base parameters belong to links that can exist.
        notes: For people.
    """

    inertial: FloatArray
    coulomb: FloatArray
    viscous: FloatArray
    mismatch: FloatArray
    own: bool
    exact: bool
    notes: tuple[str, ...]


def identified_parameters(model: RobotEstimator) -> IdentifiedParameters:
    """Consistent parameters of a fitted model, and its friction as URDF can say it.

    Raises:
        FitError: The model has no rigid part, or no consistent parameters could be found.
        PluginError: cvxpy is needed and not installed.
    """
    motion = _sampled(model)
    _, torque = rigid_asked(model, motion)
    given = getattr(getattr(model, "base_", model), "inertial_", None)
    W = model.robot_.regressor(*motion, rotor=True)
    own = given is not None
    inertial, exact = (np.asarray(given), True) if own else _nearest(model, W, torque)
    coulomb, viscous = plain_friction(model)
    error = (torque.ravel() - W @ inertial).reshape(torque.shape)
    mismatch = np.sqrt(np.mean(error**2, axis=0))
    notes = []
    if not exact:
        notes.append(
            "no links within bounds have the model's base parameters; these come nearest "
            "(rigid-lmi fits links that exist)"
        )
    return IdentifiedParameters(inertial, coulomb, viscous, mismatch, own, exact, tuple(notes))


def rigid_parameters(model: RobotEstimator) -> FloatArray:
    """(11n,) parameters with the model's rigid torques; not those of links that can exist.

    Raises:
        FitError: The model has no rigid part, or one that no links make.
    """
    motion, base = _sampled(model), base_parameters(model.robot_, rotor=True)
    _, torque = rigid_asked(model, motion)
    W = base.regressor(model.robot_, *motion)
    parameters = base.expand(np.asarray(np.linalg.lstsq(W, torque.ravel())[0], np.float64))
    error = torque - model.robot_.torque(parameters, *motion)
    if np.any(np.abs(error).max(axis=0) > RIGID_SHARE * np.abs(torque).max()):
        raise FitError(
            f"the gravity and inertia of {model.estimator} are not those of any rigid body",
            hint="fit a rigid-body model: rigid-hysteresis, rigid-wls",
        )
    return parameters


def _nearest(model: RobotEstimator, W: FloatArray, torque: FloatArray) -> tuple[FloatArray, bool]:
    """(11n,) consistent links near the nominal ones that make these torques, and if they do."""
    robot, base = model.robot_, base_parameters(model.robot_, rotor=True)
    weight = 1.0 / np.maximum(SMALLEST_SHARE * np.abs(torque).max(axis=0), 1e-9)
    rows = np.tile(weight, len(torque))
    X, y = base.reduce(W) * rows[:, None], torque.ravel() * rows
    bounds = InertialBounds.nominal(robot)
    found = consistent_least_squares(X, y, base=base, bounds=bounds).inertial
    wanted = np.linalg.lstsq(X, y, rcond=None)[0]
    moved, fine = _exact(found, wanted, base, robot.n)
    left = np.abs(y - X @ wanted) / rows
    return moved, fine and bool(np.all(left <= RIGID_SHARE * np.abs(torque).max()))


def _exact(
    inertial: FloatArray, wanted: FloatArray, base: BaseParameters, n: int
) -> tuple[FloatArray, bool]:
    """The parameters moved to the wanted base parameters, if that leaves every link a body."""
    moved = inertial.copy()
    moved[base.independent] += wanted - base.combine(inertial)
    fine = np.all(is_consistent(moved[: 10 * n].reshape(n, 10))) and np.all(moved[10 * n :] >= 0)
    return (moved, True) if fine else (inertial, False)


def _sampled(model: RobotEstimator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """q, qd, qdd (SAMPLES, n), each row by itself."""
    robot, random = model.robot_, np.random.default_rng(0)
    low, high = _range(model)
    unit = random.uniform(-1.0, 1.0, (3, SAMPLES, robot.n))
    q = low + (unit[0] + 1.0) / 2.0 * (high - low)
    return q, SPEED_RAD_S * unit[1], ACCELERATION_RAD_S2 * unit[2]


def _range(model: RobotEstimator) -> tuple[FloatArray, FloatArray]:
    robot = model.robot_
    low = np.where(np.isfinite(robot.q_min), robot.q_min, -REACH_RAD)
    return low, np.where(np.isfinite(robot.q_max), robot.q_max, REACH_RAD)


def rigid_asked(
    model: RobotEstimator, motion: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Gravity alone, and all that the model says of bodies without friction, each (N, n) [N·m].

    Raises:
        FitError: It does not tell them from the rest.
    """
    parts = _asked(model, np.arange(len(motion[0])) / FRICTION_HZ, *motion).components
    if not {"gravity", "inertia"} <= parts.keys():
        raise FitError(
            f"{model.estimator} does not tell gravity and inertia apart, so there are no links",
            hint="export a rigid-body model; of other models --to json writes what they know",
        )
    whole = sum(parts[name] for name in RIGID if name in parts)
    return parts["gravity"] * model.torque_scale_, np.asarray(whole * model.torque_scale_)


def plain_friction(model: RobotEstimator, hz: float = FRICTION_HZ) -> tuple[FloatArray, FloatArray]:
    """Coulomb and viscous friction (n,) that come nearest to the model's on a smooth motion."""
    qd, torque = friction_asked(model, hz)
    terms = np.stack(list(friction_terms(qd, SIGN_WIDTH).values()))
    found = np.array(
        [np.linalg.lstsq(terms[:, :, j].T, torque[:, j], rcond=None)[0] for j in range(qd.shape[1])]
    )
    return np.maximum(found[:, 0], 0.0), np.maximum(found[:, 1], 0.0)


def friction_asked(model: RobotEstimator, hz: float) -> tuple[FloatArray, FloatArray]:
    """A smooth motion's velocity, and the model's friction on it; zeros if it tells none."""
    t = np.arange(0.0, FRICTION_S, 1.0 / hz)
    low, high = _range(model)
    q, qd, qdd = np.zeros((3, len(t), model.robot_.n))
    for j in range(model.robot_.n):
        for k, share in enumerate((0.6, 0.4)):
            w = 2 * np.pi * (0.11 + 0.07 * k + 0.013 * j)
            size = share * min(SPEED_RAD_S / w, (high[j] - low[j]) / 2)
            q[:, j] += size * np.sin(w * t)
            qd[:, j] += size * w * np.cos(w * t)
            qdd[:, j] -= size * w * w * np.sin(w * t)
    asked = _asked(model, t, q + (low + high) / 2, qd, qdd)
    friction = asked.components.get("friction")
    return qd, np.zeros_like(qd) if friction is None else friction * model.torque_scale_


def _asked(
    model: RobotEstimator, t: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> Prediction:
    """The model's prediction for a motion as it is, nothing filtered, nothing mounted."""
    physics: RobotEstimator = getattr(model, "base_", model)  # a network has no links
    return physics.predict(motion_of(model, t, q, qd, qdd))
