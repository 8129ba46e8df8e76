"""Programs from fitted models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hil.core import FitError, FloatArray
from hil.dynamics import RobotModel, base_parameters
from hil.estimators import (
    NARROWEST,
    TERMS,
    FrictionLaw,
    RigidDiffnea,
    RigidHysteresis,
    RigidLinear,
    RobotEstimator,
    StaticModel,
)
from hil.export.lagrangian_terms import NetworkFriction, lagrangian_friction, lagrangian_terms
from hil.export.program import BODY, PlainFriction, Program, bodies
from hil.export.shaped import ShapedFriction, shaped_of
from hil.networks import CorrectedModel, LagrangianModel


class NotExported(FitError):
    """The model is of a kind that no program can be written of."""


def program_of(model: RobotEstimator) -> Program:
    """What the model computes, as arithmetic.

    Raises:
        NotExported: It is of a kind that is not exported.
        FitError: It is not fitted.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    if isinstance(model, CorrectedModel):
        return _corrected(model)
    if isinstance(model, RigidHysteresis):
        base = base_parameters(model.robot_, rotor=True)
        rigid, gears = (base.expand(beta) for beta in (model.rigid_, model.gear_rigid_))
        return _program(model, rigid, gears, model.law_)
    if isinstance(model, LagrangianModel):
        nothing = np.zeros((BODY + 1) * model.robot_.n)
        program = _program(model, nothing, nothing, lagrangian_friction(model))
        return replace(program, lagrangian=lagrangian_terms(model))
    if isinstance(model, RigidDiffnea):
        base = base_parameters(model.robot_, rotor=True)
        own = model.coefficients_[: base.rank]
        rigid, gears = (base.expand(beta) for beta in (own, model.gear_rigid_))
        return _program(model, rigid, gears, shaped_of(model))
    if isinstance(model, RigidLinear):
        n = model.robot_.n
        beta, friction = np.split(model.coefficients_, [-len(TERMS) * n])
        rigid = base_parameters(model.robot_, rotor=True).expand(beta)
        coulomb, viscous, offset = friction.reshape(n, len(TERMS)).T
        exponent = np.broadcast_to(getattr(model, "exponent_", np.ones(n)), (n,))
        width = model.sign_width or NARROWEST
        plain = PlainFriction(coulomb, viscous, offset, model.sign_width, exponent, width)
        return _program(model, rigid, rigid, plain)
    if isinstance(model, StaticModel):
        raise NotExported(
            f"{model.estimator} says what an arm needs at rest, a program what it needs in motion",
            hint="guide by hand with hil.control.HandGuiding, which takes this model "
            "as it is; take its parameters with --to json; or fit rigid-hysteresis to trajectories",
        )
    raise NotExported(
        f"{model.estimator} cannot be exported as a program",
        hint="export a rigid-body model (rigid-hysteresis, rigid-wls, …), lagrangian, or residual "
        "on one of them",
    )


def _corrected(model: CorrectedModel) -> Program:
    inner = program_of(model.base_)
    correction = model.correction_
    if not np.any(correction.kept):
        return replace(inner, estimator=model.estimator)
    if correction.settings.inputs != "motion":
        raise NotExported(
            f"the residual network has inputs: {correction.settings.inputs}, so it needs the "
            "torque that a controller wants predicted",
            hint="fit residual with inputs: motion",
        )
    return replace(inner, estimator=model.estimator, correction=correction)


def _program(
    model: RobotEstimator,
    rigid: FloatArray,
    gears: FloatArray,
    friction: PlainFriction | FrictionLaw | ShapedFriction | NetworkFriction,
) -> Program:
    robot = model.robot_
    return Program(
        estimator=model.estimator,
        joint_names=model.joint_names_,
        effort_kind=model.effort_kind_,
        geometry=robot.joint_geometry(),
        gravity=np.asarray(robot.gravity_vector, dtype=np.float64),
        flange=flange_in_last_joint(robot),
        rigid=bodies(rigid, robot.n),
        gears=bodies(gears, robot.n),
        friction=friction,
        scale=model.torque_scale_,
        coupling=getattr(robot, "joints_per_motor", None),
    )


def flange_in_last_joint(robot: RobotModel) -> FloatArray:
    """(4, 4) pose of the flange in the frame of the last joint; it does not depend on q."""
    last = np.eye(4)
    for place in robot.joint_geometry().placement:
        last = last @ place
    flange = robot.flange_pose(np.zeros((1, robot.n)))[0]
    return np.asarray(np.linalg.solve(last, flange))
