"""What a fitted model says about an arm at rest, whichever estimator made it.

A model predicts the effort of its drives: gravity, an offset, friction. What the parts of that
prediction mean for the arm itself is told here, in N·m:

- **gravity** (and the load) is what holds the arm up. A brake that takes over holds exactly this.
- **offset** is what a drive's current shows beside any load: an error of its sensor, a constant of
  its motor (K₀ of eq. 16 of the static paper), friction that differs between forth and back. A
  brake does not feel it, while a drive that is to balance the arm has to give it.
- **dry friction** is what the joints themselves hold before they move.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray
from hil.data import Conditions, Dataset
from hil.estimators.base import RobotEstimator, motion_of

COULOMB, OFFSET = "coulomb", "offset"
"""Names of a joint's dry friction and offset among the parameters of a model that is linear."""


@runtime_checkable
class HasDryFriction(Protocol):
    """What a model also offers when its dry friction is no parameter `<joint>.coulomb`."""

    def dry_friction(self) -> FloatArray:
        """(n,) level of dry friction [N·m], forth and back averaged."""


@runtime_checkable
class HasBreakAway(Protocol):
    """A model that distinguishes sticking from sliding."""

    def break_away(self) -> FloatArray:
        """Return the friction (n,) that an unloaded joint at rest holds before it slides [N·m]."""


def gravity_torque(
    model: RobotEstimator, q: FloatArray, payload: Payload | None = None
) -> FloatArray:
    """(N, n) torque [N·m] that holds the arm and its load at the positions `q` (N, n).

    Args:
        model: Any fitted model whose prediction has a part `gravity`.
        q: Joint positions [rad].
        payload: What is mounted; nothing by default.

    Raises:
        FitError: The model has no gravity of its own, or was fitted to currents without drive
            gains, so that nobody knows its torques.
        DataError: `q` has another number of joints.
    """
    require_torque(model)
    return at_rest_effort(model, q, payload)["gravity"] * model.torque_scale_


def at_rest_effort(
    model: RobotEstimator, q: FloatArray, payload: Payload | None = None
) -> Mapping[str, FloatArray]:
    """The parts `gravity` (load included) and `offset` of the effort at rest, each (N, n).

    Raises:
        FitError: The model has no gravity of its own.
        DataError: `q` has another number of joints.
    """
    load = payload or Payload()
    parts = dict(model.predict(resting_at(model, np.atleast_2d(q), load)).components)
    if "gravity" not in parts:
        have = ", ".join(parts) or "no parts at all"
        raise FitError(
            f"the model {model.estimator} does not tell gravity from the rest: it predicts {have}",
            hint="fit an estimator with a gravity part: static-wls, rigid-wls",
        )
    gravity = parts["gravity"] + _load_part(model, parts, q, load)
    if OFFSET in parts:
        return {"gravity": gravity, "offset": parts[OFFSET]}
    # Dynamic models count it as friction; it is among their parameters all the same.
    torque = _per_joint(model, OFFSET)
    offset = np.zeros(gravity.shape[1]) if torque is None else torque / model.torque_scale_
    return {"gravity": gravity, "offset": np.broadcast_to(offset, gravity.shape)}


def dry_friction(model: RobotEstimator) -> FloatArray | None:
    """(n,) level of dry friction [N·m], None where the model or its torques do not say.

    It is the friction of a joint that slides; one that sticks holds at least as much while it is
    as cold as in the recording.
    """
    if not model.knows_gains:
        return None
    if isinstance(model, HasDryFriction):
        return np.abs(model.dry_friction())
    level = _per_joint(model, COULOMB)
    return None if level is None else np.abs(level)


def holding_friction(model: RobotEstimator) -> FloatArray | None:
    """Return what the joints at rest hold before they move, (n,) [N·m]; None where not known.

    It is the break-away level of a model whose friction has a memory. A model without one has the
    friction of a joint that slides in its place (`dry_friction`).
    """
    if model.knows_gains and isinstance(model, HasBreakAway):
        return model.break_away()
    return dry_friction(model)


def require_torque(model: RobotEstimator) -> None:
    """Refuse a model of currents that nobody can turn into torques.

    Raises:
        FitError: It was fitted without drive gains.
    """
    if not model.knows_gains:
        raise FitError(
            f"the model {model.estimator} was fitted to currents without drive gains: nobody knows "
            "how much torque they are",
            hint="fit again on data that say their drive gains",
        )


def _per_joint(model: RobotEstimator, name: str) -> FloatArray | None:
    """(n,) parameters `<joint>.<name>` [N·m], None where a joint has none."""
    values: Any = getattr(model, "coefficients_", None)
    if values is None:  # names of parameters alone, as friction with memory has
        return None
    known = dict(zip(getattr(model, "parameter_names_", ()), values, strict=True))
    own = [known.get(f"{joint}.{name}") for joint in model.joint_names_]
    return None if None in own else np.array(own, dtype=np.float64)


def _load_part(
    model: RobotEstimator, parts: Mapping[str, FloatArray], q: FloatArray, load: Payload
) -> FloatArray:
    """(N, n) effort of the load, from the robot model where the prediction has no such part."""
    if load.is_empty:
        return np.zeros_like(parts["gravity"])
    if "payload" in parts:
        return parts["payload"]
    require_torque(model)
    still = np.zeros_like(q)
    torque: FloatArray = model.robot_.payload_effort(load, q, still, still)
    return torque / model.torque_scale_


def resting_at(model: RobotEstimator, q: FloatArray, load: Payload) -> Dataset:
    """Positions (N, n) as a recording of an arm that rests there, filters already applied.

    Raises:
        DataError: `q` has another number of joints.
    """
    n = len(model.joint_names_)
    if q.ndim != 2 or q.shape[1] != n:
        raise DataError(f"the model has {n} joints, the positions have the shape {q.shape}")
    still = np.zeros_like(q)
    whole = motion_of(model, np.arange(len(q), dtype=np.float64), q, still, still)
    return replace(whole, conditions=(Conditions("at rest", "dwell", payload=load),))
