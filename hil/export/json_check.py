"""Whether a JSON document says what the model says: computed from its numbers alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from hil.core import FitError, FloatArray
from hil.dynamics import base_parameters
from hil.estimators import RigidHysteresis, RigidLinear, RobotEstimator, StaticModel, motion_of
from hil.export.golden import LOAD, RATE_HZ, golden_of
from hil.export.json_columns import Document, friction_torque
from hil.export.json_read import combined, links_of, rigid_torque, torque_per_effort
from hil.export.json_rest import at_rest
from hil.export.program import bodies
from hil.networks import CorrectedModel, LagrangianModel

EXACT = 1e-9
"""Largest difference as a share of each joint's largest value: numbers are written in full."""

SINGLE = 1e-5
"""The same for what a network computes in single precision."""

NOTHING = 1e-9
"""Joints whose largest value is less than this have none."""

LOAD_ROW = np.array([LOAD.mass, *LOAD.com, *LOAD.inertia])


class Compared(NamedTuple):
    """Something that the model says (N, n), and how it follows from a document."""

    what: str
    theirs: FloatArray
    ours: Callable[[Document], FloatArray]


def checked(model: RobotEstimator, document: Document) -> str:
    """What was compared, how well it agrees and what was not compared.

    Args:
        model: Fitted.
        document: As it is read back from JSON.

    Raises:
        FitError: The document says something else than the model.
    """
    physics = model.base_ if isinstance(model, CorrectedModel) else model
    told = differences(physics, document, comparisons(physics, document))
    alone = "computed from the document alone, largest difference as a share of the largest value: "
    left_out = _not_compared(physics, document)
    more = [f"not compared: {', '.join(left_out)}"] if left_out else []
    return "; ".join([alone + ", ".join(told), *more] if told else more)


def differences(
    physics: RobotEstimator, document: Document, compared: Sequence[Compared]
) -> list[str]:
    """How well each agrees, in words.

    Raises:
        FitError: One does not.
    """
    told = []
    for what, theirs, ours in compared:
        with np.errstate(all="ignore"):
            difference = _difference(ours(document), theirs)
        if not difference < (SINGLE if isinstance(physics, LagrangianModel) else EXACT):
            raise FitError(
                f"{what} computed from the document differ from the model's by {difference:.1g} "
                "of the largest",
                hint="please report this; the model folder itself is as it was",
            )
        told.append(f"{what}: {difference:.1g}")
    return told


def comparisons(physics: RobotEstimator, document: Document) -> list[Compared]:
    """All that can be compared of a model, evaluated once; of the document what there is counts."""
    found: list[Compared] = []
    if isinstance(physics, RigidLinear | RigidHysteresis | LagrangianModel):
        found += _efforts(physics)
    elif isinstance(physics, StaticModel):
        found += [Compared(*one) for one in at_rest(physics)]
    if isinstance(physics, LagrangianModel) and physics.intrinsic_:
        found.append(_curve(physics))
    gear = getattr(physics, "gear_rigid_", None)
    if gear is not None and any(one["group"] == "gear" for one in document["parameters"]):
        found.append(_gear(physics, gear))
    if document["links"]["values"] is not None:
        found += _links(physics)
    return found


def _difference(ours: FloatArray, theirs: FloatArray) -> float:
    """Largest of any joint, as a share of the joint's largest; of all where it has none."""
    largest = np.abs(theirs).max(axis=0)
    whole = float(largest.max())
    scale = np.where(largest > NOTHING * whole, largest, whole or 1.0)
    return float(np.max(np.abs(ours - theirs) / scale))


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


def _creeping(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """q, qd, qdd (N, n): speeds from 1e-8 rad/s up, both ways, as golden vectors hardly have."""
    speed = np.repeat(np.geomspace(1e-8, 1.0, 33), 2) * np.tile([1.0, -1.0], 33)
    qd = np.outer(speed, np.ones(n))
    return np.cumsum(0.004 * qd, axis=0), qd, np.zeros_like(qd)


def _computed(
    physics: RobotEstimator, motion: tuple[FloatArray, FloatArray, FloatArray]
) -> Callable[[Document, FloatArray | None], FloatArray]:
    """Whole efforts, sample by sample, from a document; what networks add is the model's own."""
    learnt = np.zeros_like(motion[0])
    if isinstance(physics, LagrangianModel):
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


def _curve(physics: LagrangianModel) -> Compared:
    """Friction alone, at steady speeds: in efforts its rounding is that of the whole network."""
    from hil.networks import network_of

    network = network_of(physics.design_, physics.torque_std_, physics.weights_)
    qd = _creeping(physics.robot_.n)[1]
    known, none = {"s": np.sign(qd), "z": np.sign(qd)}, np.zeros_like(qd)
    theirs = np.asarray(network.friction.curve(qd))
    return Compared(
        "friction at steady speeds", theirs, lambda d: friction_torque(d, none, qd, none, known)
    )


def _gear(physics: RobotEstimator, gear: FloatArray) -> Compared:
    random = np.random.default_rng(0)  # every row by itself, so that no parameter hides
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


def _not_compared(physics: RobotEstimator, document: Document) -> list[str]:
    left_out = []
    if document["networks"]:
        left_out.append("networks, whose weights are not in the document")
    groups: set[Any] = {one["group"] for one in document["parameters"]}
    if not (groups - {"unknown"} or document["networks"]):
        left_out.append("an estimator that this version of hil does not know")
    return left_out
