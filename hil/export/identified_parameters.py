"""Physically consistent inertial parameters and simple friction of a fitted model.

Some estimators have physically consistent parameters (`inertial_`). Other estimators only have base
parameters, or no named parameters. For estimators without consistent parameters, physically
consistent links near the nominal links are computed that reproduce the rigid torques at sampled
motions (`hil.estimators.consistent`). If consistent links with the model's base parameters exist,
the computed links have exactly these base parameters, and only parameters that do not influence the
torques are chosen freely.
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
"""Acceleration range [rad/s²] of the sampled motions; a typical value of an excitation."""

REACH_RAD = np.pi
"""Range [rad] of the sampled motions for joints without limits."""

SMALLEST_SHARE = 1e-3
"""Accuracy of the torque fit, as a share of a joint's largest torque, if no exact fit exists."""

RIGID_SHARE = 1e-6
"""Largest residual of a rigid-body fit, as a share of the largest rigid torque."""

RIGID = ("gravity", "inertia", "coriolis")
"""Names of the components of a prediction that are caused by rigid bodies."""

FRICTION_S, FRICTION_HZ = 60.0, 1000.0
SIGN_WIDTH = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedParameters:
    """Identified parameters of an arm: links and friction.

    Attributes:
        inertial: (11n,) parameters of the links in the order of
            `RobotModel.parameters(rotor=True)`.
        coulomb: (n,) friction that does not depend on the speed [N·m], at least 0.
        viscous: (n,) friction per unit of speed [N·m·s/rad], at least 0.
        mismatch: (n,) RMS difference over sampled motions between the torque of the parameters
            `inertial` and the model's rigid torque [N·m].
        own: Whether the model itself contains the parameters `inertial`.
        exact: Whether the parameters `inertial` must reproduce the model's torques exactly. Exact
            reproduction is required for parameters that the model itself contains, and if
            consistent links with the base parameters of the model exist.
        notes: Notes for the operator.
    """

    inertial: FloatArray
    coulomb: FloatArray
    viscous: FloatArray
    mismatch: FloatArray
    own: bool
    exact: bool
    notes: tuple[str, ...]


def identified_parameters(model: RobotEstimator) -> IdentifiedParameters:
    """Return consistent parameters of a fitted model, and its friction in the form of URDF.

    Raises:
        FitError: The model has no rigid part, or no consistent parameters could be computed.
        PluginError: The package cvxpy is required and not installed.
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
            "no physically consistent links within the bounds have the model's base parameters; "
            "the nearest ones were written (rigid-lmi fits consistent links)"
        )
    return IdentifiedParameters(inertial, coulomb, viscous, mismatch, own, exact, tuple(notes))


def rigid_parameters(model: RobotEstimator) -> FloatArray:
    """Return parameters (11n,) with the model's rigid torques; the links can be inconsistent.

    Raises:
        FitError: The model has no rigid part, or no links have the model's rigid torques.
    """
    motion, base = _sampled(model), base_parameters(model.robot_, rotor=True)
    _, torque = rigid_asked(model, motion)
    W = base.regressor(model.robot_, *motion)
    parameters = base.expand(np.asarray(np.linalg.lstsq(W, torque.ravel())[0], np.float64))
    error = torque - model.robot_.torque(parameters, *motion)
    if np.any(np.abs(error).max(axis=0) > RIGID_SHARE * np.abs(torque).max()):
        raise FitError(
            f"the gravity and inertia of {model.estimator} are not those of rigid bodies",
            hint="fit a rigid-body model: rigid-hysteresis, rigid-wls",
        )
    return parameters


def _nearest(model: RobotEstimator, W: FloatArray, torque: FloatArray) -> tuple[FloatArray, bool]:
    """Return consistent links (11n,) near the nominal links, and whether they fit exactly."""
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
    """Move parameters to the requested base parameters if all links stay consistent.

    Returns:
        Parameters, and whether the parameters were moved.
    """
    moved = inertial.copy()
    moved[base.independent] += wanted - base.combine(inertial)
    fine = np.all(is_consistent(moved[: 10 * n].reshape(n, 10))) and np.all(moved[10 * n :] >= 0)
    return (moved, True) if fine else (inertial, False)


def _sampled(model: RobotEstimator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return random q, qd, qdd (SAMPLES, n) with independent rows."""
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
    """Return torques of gravity alone and of all rigid-body terms, each (N, n) [N·m].

    Raises:
        FitError: The model does not separate gravity and inertia from the other parts.
    """
    parts = _asked(model, np.arange(len(motion[0])) / FRICTION_HZ, *motion).components
    if not {"gravity", "inertia"} <= parts.keys():
        raise FitError(
            f"{model.estimator} does not separate gravity and inertia, so it has no link "
            "parameters",
            hint="export a rigid-body model, or write the parameters with --to json",
        )
    whole = sum(parts[name] for name in RIGID if name in parts)
    return parts["gravity"] * model.torque_scale_, np.asarray(whole * model.torque_scale_)


def plain_friction(model: RobotEstimator, hz: float = FRICTION_HZ) -> tuple[FloatArray, FloatArray]:
    """Return the Coulomb and viscous friction (n,) that is nearest to the model's friction."""
    qd, torque = friction_asked(model, hz)
    terms = np.stack(list(friction_terms(qd, SIGN_WIDTH).values()))
    found = np.array(
        [np.linalg.lstsq(terms[:, :, j].T, torque[:, j], rcond=None)[0] for j in range(qd.shape[1])]
    )
    return np.maximum(found[:, 0], 0.0), np.maximum(found[:, 1], 0.0)


def friction_asked(model: RobotEstimator, hz: float) -> tuple[FloatArray, FloatArray]:
    """Return the velocity of a smooth motion and the model's friction, zero without friction."""
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
    """Return the model's prediction for an unfiltered motion without a load."""
    physics: RobotEstimator = getattr(model, "base_", model)  # a residual network has no links
    return physics.predict(motion_of(model, t, q, qd, qdd))
