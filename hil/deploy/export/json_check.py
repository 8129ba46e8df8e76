"""Whether a JSON document says what the model says: computed from its numbers alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from hil.data.dataset import Conditions, Dataset
from hil.deploy.export.golden import LOAD, RATE_HZ, SAMPLES, golden_of, motion
from hil.deploy.export.json_read import (
    combined,
    friction_torque,
    links_of,
    of_joints,
    paper_gravity,
    rigid_torque,
    steady_friction,
)
from hil.errors import FitError
from hil.identify.base import RobotEstimator
from hil.identify.lagrangian.fitted import LagrangianModel
from hil.identify.motor import has_current
from hil.identify.residual.fitted import CorrectedModel
from hil.identify.rigid_hysteresis import RigidHysteresis
from hil.identify.rigid_linear import RigidLinear
from hil.identify.static_inverse import StaticInverse
from hil.identify.static_model import StaticModel
from hil.typing import FloatArray

EXACT = 1e-9
"""Largest difference as a share of each joint's largest value: numbers are written in full."""

SINGLE = 1e-5
"""The same for what a network computes in single precision."""

NOTHING = 1e-9
"""Joints whose largest value is less than this have none."""

Compared = tuple[str, FloatArray, FloatArray]


def checked(model: RobotEstimator, document: dict[str, Any]) -> str:
    """What was compared, how well it agrees and what was not compared.

    Args:
        model: Fitted.
        document: As it is read back from JSON.

    Raises:
        FitError: The document says something else than the model.
    """
    physics = model.base_ if isinstance(model, CorrectedModel) else model
    told = []
    for what, ours, theirs in _pairs(physics, document):
        difference = _difference(ours, theirs)
        if not difference < (SINGLE if isinstance(physics, LagrangianModel) else EXACT):
            raise FitError(
                f"{what} computed from the document differ from the model's by {difference:.1g} "
                "of the largest",
                hint="please report this; the model folder itself is as it was",
            )
        told.append(f"{what}: {difference:.1g}")
    alone = "computed from the document alone, largest difference as a share of the largest value: "
    left_out = _not_compared(physics, document)
    more = [f"not compared: {', '.join(left_out)}"] if left_out else []
    return "; ".join([alone + ", ".join(told), *more] if told else more)


def _difference(ours: FloatArray, theirs: FloatArray) -> float:
    """Largest of any joint, as a share of the joint's largest; of all where it has none."""
    largest = np.abs(theirs).max(axis=0)
    whole = float(largest.max())
    scale = np.where(largest > NOTHING * whole, largest, whole or 1.0)
    return float(np.max(np.abs(ours - theirs) / scale))


def _pairs(model: RobotEstimator, document: dict[str, Any]) -> Iterator[Compared]:
    q, qd, qdd = motion(model.robot_, SAMPLES, RATE_HZ)
    if isinstance(model, RigidLinear) and not document["friction"]["memory"]:
        golden, scale = golden_of(model), model.torque_scale_
        bare = (document, golden.q, golden.qd, golden.qdd)
        friction = friction_torque(document, golden.qd)
        load = np.array([LOAD.mass, *LOAD.com, *LOAD.inertia])
        yield f"{SAMPLES} efforts", (rigid_torque(*bare) + friction) / scale, golden.bare
        loaded = rigid_torque(*bare, load=load)
        yield "efforts with a load", (loaded + friction) / scale, golden.loaded
    elif isinstance(model, RigidLinear | RigidHysteresis):
        parts = model.predict(_as_it_is(model, q, qd, qdd)).components
        theirs = (parts["gravity"] + parts["inertia"]) * model.torque_scale_
        yield "torques of gravity and inertia", rigid_torque(document, q, qd, qdd), theirs
    elif isinstance(model, StaticModel):
        yield from _static(model, document, q)
    elif isinstance(model, LagrangianModel) and model.intrinsic_:
        speeds = np.where(np.abs(qd) < 1e-3, 0.1, qd)
        yield "friction at steady speeds", steady_friction(document, speeds), _curve(model, speeds)
    if document["links"]["values"] is not None:
        ours = rigid_torque(document, q, qd, qdd, links=links_of(document))
        yield "torques of links and base parameters", ours, rigid_torque(document, q, qd, qdd)
        values, sums = combined(document).T
        yield "base parameters as sums of those of links", sums[:, None], values[:, None]


def _curve(model: LagrangianModel, speeds: FloatArray) -> FloatArray:
    """(N, n) friction of the network itself [N·m]."""
    from hil.identify.lagrangian.stored import network_of

    network = network_of(model.design_, model.torque_std_, model.weights_)
    return np.asarray(network.friction.curve(speeds))


def _static(model: StaticModel, document: dict[str, Any], q: FloatArray) -> Iterator[Compared]:
    still = np.zeros_like(q)
    if model.form == "paper":
        gravity = paper_gravity(document, q)
    else:
        gravity = rigid_torque(document, q, still, still, "gravity")
    offset = of_joints(document, "offset")
    # As every static model does: without networks and friction, which a pose alone does not tell.
    told = StaticModel.predict(model, _as_it_is(model, q, still, still))
    if isinstance(model, StaticInverse):
        k1, k2 = model.torque_scale_, of_joints(document, "square")
        torque = k2 * told.effort * np.abs(told.effort) + k1 * told.effort - offset
        there = has_current(gravity, k1, k2, -offset)
        yield "gravity of the currents by eq. 16", torque * there, gravity * there
        return
    theirs = (told.components["gravity"] + told.components["offset"]) * model.torque_scale_
    yield "gravity and offset", gravity + offset, theirs


def _not_compared(physics: RobotEstimator, document: dict[str, Any]) -> list[str]:
    left_out = []
    if document["friction"]["memory"]:
        left_out.append("friction")
    groups = {one["group"] for one in document["parameters"]}
    if not isinstance(physics, StaticInverse):
        left_out += sorted(groups & {"drive", "ripple"})
    if document["networks"]:
        left_out.append("networks, whose weights are not in the document")
    if not (groups - {"unknown"} or document["networks"]):
        left_out.append("an estimator that this version of hil does not know")
    return left_out


def _as_it_is(model: RobotEstimator, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Dataset:
    """A motion (N, n), filtered already, nothing mounted."""
    none = np.zeros_like(q)
    columns = {"t": np.arange(len(q)) / RATE_HZ, "q": q, "qd": qd, "effort": none}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": none}
    x, y, z = (float(value) for value in model.robot_.gravity_vector)
    return Dataset(
        robot=model.robot_.name,
        joint_names=model.joint_names_,
        effort_kind="torque" if model.effort_kind_ == "torque" else "current",
        columns=columns,
        offsets=np.array([0, len(q)], dtype=np.int64),
        conditions=(Conditions("golden", "trajectory"),),
        drive_gains=model.torque_scale_,
        gravity=(x, y, z),
    )
