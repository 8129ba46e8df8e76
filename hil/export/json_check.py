"""Check that a JSON document reproduces the predictions of its model from its numbers alone.

Models of motion are compared by their efforts on the golden motion (see `hil.export.agreement`) and
at low speeds. Static models are compared by gravity, drive and friction at standstill. Physically
consistent links and torques through the gears are also compared if the document contains them.
Network contributions are not in a document; the check takes these contributions from the model and
reports them as not compared.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.data import ARRIVAL_POINTS, ARRIVAL_STEP_S
from hil.dynamics import base_parameters
from hil.estimators import (
    RigidHysteresis,
    RigidLinear,
    RobotEstimator,
    StaticFriction,
    StaticInverse,
    StaticModel,
    dwells_of,
    estimator,
    has_current,
    motion_of,
)
from hil.export.agreement import LOAD, RATE_HZ, SAMPLES, golden_of, motion
from hil.export.json_reader import (
    Document,
    combined,
    friction_torque,
    links_of,
    of_joints,
    paper_gravity,
    rest_states,
    rigid_torque,
    torque_per_effort,
)
from hil.export.program import bodies
from hil.networks import LagrangianEstimator, ResidualNetwork

EXACT = 1e-9
"""Largest permitted difference between document and model, as a share of a joint's largest value.

The tolerance is small, because a document contains all digits of its numbers.
"""

SINGLE = 1e-5
"""Largest permitted difference for values that a network computes in single precision."""

NOTHING = 1e-9
"""Minimum of a joint's reference value, as a share of the largest value of all joints."""

LOAD_ROW = np.array([LOAD.mass, *LOAD.com, *LOAD.inertia])


class Compared(NamedTuple):
    """Values (N, n) of the model, and the function that computes these values from a document."""

    what: str
    theirs: FloatArray
    ours: Callable[[Document], FloatArray]


def checked(model: RobotEstimator, document: Document) -> str:
    """Return a text with the compared values, their largest differences and the omitted values.

    Args:
        model: Fitted model.
        document: Document after reading it back from JSON.

    Raises:
        FitError: A value that is computed from the document differs from the value of the model.
    """
    physics = model.base_ if isinstance(model, ResidualNetwork) else model
    told = differences(physics, document, comparisons(physics, document))
    alone = "computed from the document alone, largest difference as a share of the largest value: "
    left_out = _not_compared(physics, document)
    more = [f"not compared: {', '.join(left_out)}"] if left_out else []
    return "; ".join([alone + ", ".join(told), *more] if told else more)


def _not_compared(physics: RobotEstimator, document: Document) -> list[str]:
    left_out = []
    if document["networks"]:
        left_out.append("networks, whose weights are not in the document")
    groups: set[Any] = {one["group"] for one in document["parameters"]}
    if not (groups - {"unknown"} or document["networks"]):
        left_out.append("an estimator that is unknown to this version of hil")
    return left_out


def differences(
    physics: RobotEstimator, document: Document, compared: Sequence[Compared]
) -> list[str]:
    """Return the largest difference of each comparison as text.

    Raises:
        FitError: A difference exceeds the tolerance.
    """
    told = []
    for what, theirs, ours in compared:
        with np.errstate(all="ignore"):
            difference = _difference(ours(document), theirs)
        if not difference < (SINGLE if isinstance(physics, LagrangianEstimator) else EXACT):
            raise FitError(
                f"{what} computed from the document differ from the model's by {difference:.1g} "
                "of the largest",
                hint="please report this fault; the model folder is unchanged",
            )
        told.append(f"{what}: {difference:.1g}")
    return told


def _difference(ours: FloatArray, theirs: FloatArray) -> float:
    """Return the largest difference of any joint, as a share of the joint's largest value.

    For joints whose values are almost zero, the reference is the largest value of all joints.
    """
    largest = np.abs(theirs).max(axis=0)
    whole = float(largest.max())
    scale = np.where(largest > NOTHING * whole, largest, whole or 1.0)
    return float(np.max(np.abs(ours - theirs) / scale))


def comparisons(physics: RobotEstimator, document: Document) -> list[Compared]:
    """Return all comparisons that are possible for a model and a document."""
    found: list[Compared] = []
    if isinstance(physics, RigidLinear | RigidHysteresis | LagrangianEstimator):
        found += _efforts(physics)
    elif isinstance(physics, StaticModel):
        found += _at_rest(physics)
    if isinstance(physics, LagrangianEstimator) and physics.intrinsic_:
        found.append(_curve(physics))
    gear = getattr(physics, "gear_rigid_", None)
    if gear is not None and any(one["group"] == "gear" for one in document["parameters"]):
        found.append(_gear(physics, gear))
    if document["links"]["values"] is not None:
        found += _links(physics)
    return found


def _efforts(physics: RobotEstimator) -> Iterator[Compared]:
    golden = golden_of(physics)
    motion = (golden.q, golden.qd, golden.qdd)
    ours = _computed(physics, motion)
    yield Compared(f"{len(golden.q)} efforts", golden.bare, lambda d: ours(d, None))
    yield Compared("efforts with a load", golden.loaded, lambda d: ours(d, LOAD_ROW))
    slow, stream = _creeping(physics.robot_.n), physics.stream()
    theirs = np.array([stream.step(*row) for row in zip(*slow, strict=True)])
    creeping = _computed(physics, slow)
    yield Compared("efforts at low speeds", theirs, lambda d: creeping(d, None))


def _computed(
    physics: RobotEstimator, motion: tuple[FloatArray, FloatArray, FloatArray]
) -> Callable[[Document, FloatArray | None], FloatArray]:
    """Return a function that computes efforts from a document, sample by sample.

    The function takes the contributions of networks from the model.
    """
    learnt = np.zeros_like(motion[0])
    if isinstance(physics, LagrangianEstimator):
        t = np.arange(len(learnt)) / RATE_HZ
        parts = physics.predict(motion_of(physics, t, *motion)).components
        names = ["inertia", "coriolis", "gravity"] + ["friction"] * (not physics.intrinsic_)
        learnt = sum((parts[name] for name in names), start=learnt) * physics.torque_scale_

    def effort(document: Document, load: FloatArray | None) -> FloatArray:
        torque = learnt + rigid_torque(document, *motion, load=load)
        through = rigid_torque(document, *motion, "gear", load=load)
        friction = friction_torque(document, motion[0], motion[1], through)
        return (torque + friction) / torque_per_effort(document)

    return effort


def _creeping(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return q, qd, qdd (N, n) with speeds from 1e-8 to 1 rad/s in both directions.

    Golden vectors contain almost no samples at speeds as low as 1e-8 rad/s.
    """
    speed = np.repeat(np.geomspace(1e-8, 1.0, 33), 2) * np.tile([1.0, -1.0], 33)
    qd = np.outer(speed, np.ones(n))
    return np.cumsum(0.004 * qd, axis=0), qd, np.zeros_like(qd)


def _curve(physics: LagrangianEstimator) -> Compared:
    """Return the comparison of friction alone at steady speeds.

    Friction is compared separately, because efforts also contain the rounding errors of the whole
    network.
    """
    from hil.networks import network_of

    network = network_of(physics.design_, physics.torque_std_, physics.weights_)
    qd = _creeping(physics.robot_.n)[1]
    known, none = {"s": np.sign(qd), "z": np.sign(qd)}, np.zeros_like(qd)
    theirs = np.asarray(network.friction.curve(qd))
    return Compared(
        "friction at steady speeds", theirs, lambda d: friction_torque(d, none, qd, none, known)
    )


def _gear(physics: RobotEstimator, gear: FloatArray) -> Compared:
    random = np.random.default_rng(0)  # independent rows, so that every parameter matters
    q, qd, qdd = random.uniform(-2.0, 2.0, (3, 60, physics.robot_.n))
    full = base_parameters(physics.robot_, rotor=True).expand(gear)
    theirs = physics.robot_.torque(full, q, qd, qdd)
    return Compared(
        "torques through the gears", theirs, lambda d: rigid_torque(d, q, qd, qdd, "gear")
    )


def _links(physics: RobotEstimator) -> Iterator[Compared]:
    inertial: FloatArray = physics.inertial_  # type: ignore[attr-defined]
    yield Compared("links", bodies(inertial, physics.robot_.n), links_of)
    sums = base_parameters(physics.robot_, rotor=True).combine(inertial)[:, None]
    yield Compared("base parameters as sums of those of links", sums, lambda d: combined(d)[:, 1:])


CELSIUS = 40.0


def _at_rest(model: StaticModel) -> Iterator[Compared]:
    """Yield the comparisons of a static model at standstill, without and with a load."""
    q = motion(model.robot_, SAMPLES, RATE_HZ)[0]
    for what, load in (("", None), (" with a load", LOAD)):
        if load is not None and not model.knows_gains:
            continue
        if isinstance(model, StaticInverse):
            yield _inverse(model, q, load, what)
        else:
            yield _linear(model, q, load, what)
    if isinstance(model, StaticFriction):
        levels = model.dry_friction()[None]
        yield Compared("levels of dry friction", levels, _levels)
        yield Compared("levels as reported", levels, lambda d: _array(d, "level_nm"))


def _inverse(model: StaticInverse, q: FloatArray, load: Payload | None, what: str) -> Compared:
    """Return the comparison of eq. 16 with the model's currents to the gravity of the document.

    Samples for which eq. 16 has no solution for the current are skipped.
    """
    effort = StaticModel.predict(model, dwells_of(model, q, load)).effort
    k1, k2, k0 = model.constants_
    held = (k2 * np.abs(effort) + k1) * effort + k0
    there = has_current(held, k1, k2, k0)

    def ours(document: Document) -> FloatArray:
        k1, offset = torque_per_effort(document), of_joints(document, "offset")
        k2 = of_joints(document, "square")
        torque = (k2 * np.abs(effort) + k1) * effort - offset
        return np.asarray((torque - _gravity(document, q, load)) * there + held)

    return Compared(f"gravity of the currents by eq. 16{what}", held, ours)


def _gravity(
    document: Document, q: FloatArray, load: Payload | None, group: str = "gravity"
) -> FloatArray:
    """Return the torque (N, n) of the static arm and of the mounted load [N·m]."""
    still = np.zeros_like(q)
    mounted = None if load is None else LOAD_ROW
    if any("waves" in one for one in document["parameters"]):
        return paper_gravity(document, q) + rigid_torque(document, q, still, still, "", mounted)
    return rigid_torque(document, q, still, still, group, mounted)


def _linear(model: StaticModel, q: FloatArray, load: Payload | None, what: str) -> Compared:
    paths, current = _paths(q), np.cos(3.0 * q) * model.sigma_
    data = dwells_of(model, q, load, effort=current, temperature=np.full_like(q, CELSIUS))
    if isinstance(model, StaticFriction):
        both = np.stack([paths, np.gradient(paths, ARRIVAL_STEP_S, axis=1)], axis=2)
        told = _uncorrected(model).predict(replace(data, arrivals=both))
    else:
        # StaticModel.predict omits networks, which are not in the document.
        told = StaticModel.predict(model, data)

    def ours(document: Document) -> FloatArray:
        lengths = document["friction"]["constants"].get("lengths_rad", [])
        known = {"i": current, "T": np.full_like(q, CELSIUS), **rest_states(paths, lengths)}
        torque, through = _gravity(document, q, load), _gravity(document, q, load, "gear")
        own = friction_torque(document, q, np.zeros_like(q), through, known)
        return (torque + own) / torque_per_effort(document)

    return Compared(f"efforts at rest{what}", told.effort, ours)


def _paths(q: FloatArray) -> FloatArray:
    """Return parabolic paths (N, K, n) into poses, which smoothing does not change."""
    s = np.linspace(1.0, 0.0, ARRIVAL_POINTS)[None, :, None]
    return np.asarray(1e-3 * np.sign(np.sin(5.0 * q))[:, None] * s * (1.4 * s - 0.4))


def _uncorrected(model: StaticFriction) -> StaticFriction:
    """Return the model without its learned correction."""
    plain = estimator(model.estimator, **model.get_params())
    assert isinstance(plain, StaticFriction)
    plain.robot_ = model.robot_
    plain.restore(model.fitted_arrays(), model.fitted_facts() | {"correction_penalty": []})
    return plain


def _levels(document: Document) -> FloatArray:
    """Return the levels (1, n) of dry friction from the parameters of Dahl's states."""
    names = [joint["name"] for joint in document["robot"]["joints"]]
    sums = np.zeros((1, len(names)))
    for one in document["parameters"]:
        if re.fullmatch("d|z[0-9]+", one["column"]):
            sums[0, names.index(one["joint"])] += one["value"]
    return np.abs(sums)


def _array(document: Document, key: str) -> FloatArray:
    return np.array([document["friction"][key]])
