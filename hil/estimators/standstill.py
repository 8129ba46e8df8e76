"""Static quantities of a fitted model, independent of its estimator.

A model predicts the effort of its drives: gravity, an offset and friction. The module `standstill`
defines the meaning of gravity, offset and dry friction for the arm, in N·m:

- **Gravity** (including the payload) is the torque that holds the arm. A brake must hold exactly
  the gravity torque.
- **Offset** is the part of a drive's current that does not depend on the load. The causes of an
  offset are a sensor error, a constant of the motor (K₀ of eq. 16 of the static paper), and
  friction that depends on the direction. A brake does not hold the offset, whereas a drive that
  balances the arm must also produce the offset.
- **Dry friction** is the torque that the joints hold by friction before they move.
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
"""Names of the dry friction and the offset of a joint among the parameters of a linear model."""


@runtime_checkable
class HasDryFriction(Protocol):
    """Interface of a model whose dry friction is not a parameter `<joint>.coulomb`."""

    def dry_friction(self) -> FloatArray:
        """Return (n,) the level of dry friction [N·m], averaged over both directions."""


@runtime_checkable
class HasBreakAway(Protocol):
    """Interface of a model that distinguishes static from sliding friction."""

    def break_away(self) -> FloatArray:
        """Return (n,) the friction [N·m] that an unloaded static joint can hold."""


def gravity_torque(
    model: RobotEstimator, q: FloatArray, payload: Payload | None = None
) -> FloatArray:
    """Return (N, n) the torque [N·m] that holds arm and payload at the positions `q` (N, n).

    Args:
        model: Fitted model whose prediction has a component `gravity`.
        q: Joint positions [rad].
        payload: Mounted payload; None for no payload.

    Raises:
        FitError: The model has no gravity component, or was fitted to currents without drive gains,
            so that its torques are unknown.
        DataError: The number of positions in `q` differs from the number of joints.
    """
    require_torque(model)
    return at_rest_effort(model, q, payload)["gravity"] * model.torque_scale_


def at_rest_effort(
    model: RobotEstimator, q: FloatArray, payload: Payload | None = None
) -> Mapping[str, FloatArray]:
    """Return the components `gravity` and `offset` of the static effort, each (N, n).

    The gravity component includes the payload.

    Raises:
        FitError: The model has no gravity component.
        DataError: The number of positions in `q` differs from the number of joints.
    """
    load = payload or Payload()
    parts = dict(model.predict(resting_at(model, np.atleast_2d(q), load)).components)
    if "gravity" not in parts:
        have = ", ".join(parts) or "no components"
        raise FitError(
            f"the model {model.estimator} does not predict gravity as a separate component: it "
            f"predicts {have}",
            hint="fit an estimator with a gravity component: static-wls, rigid-wls",
        )
    gravity = parts["gravity"] + _load_part(model, parts, q, load)
    if OFFSET in parts:
        return {"gravity": gravity, "offset": parts[OFFSET]}
    # Dynamic models include the offset in the friction; the parameter exists all the same.
    torque = _per_joint(model, OFFSET)
    offset = np.zeros(gravity.shape[1]) if torque is None else torque / model.torque_scale_
    return {"gravity": gravity, "offset": np.broadcast_to(offset, gravity.shape)}


def dry_friction(model: RobotEstimator) -> FloatArray | None:
    """Return (n,) the level of dry friction [N·m]; None if unknown.

    The level of dry friction is the friction of a sliding joint. The friction of a static joint is
    at least as large as this level if the joint is not warmer than in the recording.
    """
    if not model.knows_gains:
        return None
    if isinstance(model, HasDryFriction):
        return np.abs(model.dry_friction())
    level = _per_joint(model, COULOMB)
    return None if level is None else np.abs(level)


def holding_friction(model: RobotEstimator) -> FloatArray | None:
    """Return (n,) the friction [N·m] that static joints can hold; None if unknown.

    For a model with friction memory, the returned friction is the break-away friction. For models
    without friction memory, the sliding friction is returned instead (`dry_friction`).
    """
    if model.knows_gains and isinstance(model, HasBreakAway):
        return model.break_away()
    return dry_friction(model)


def require_torque(model: RobotEstimator) -> None:
    """Raise if a model predicts currents that cannot be converted to torques.

    Raises:
        FitError: The model was fitted without drive gains.
    """
    if not model.knows_gains:
        raise FitError(
            f"the model {model.estimator} was fitted to currents without drive gains, so currents "
            "cannot be converted to torques",
            hint="fit again on data with declared drive gains",
        )


def _per_joint(model: RobotEstimator, name: str) -> FloatArray | None:
    """Return (n,) the parameters `<joint>.<name>` [N·m]; None if a joint lacks the parameter."""
    values: Any = getattr(model, "coefficients_", None)
    if values is None:  # models of friction with memory only have parameter names
        return None
    known = dict(zip(getattr(model, "parameter_names_", ()), values, strict=True))
    own = [known.get(f"{joint}.{name}") for joint in model.joint_names_]
    return None if None in own else np.array(own, dtype=np.float64)


def _load_part(
    model: RobotEstimator, parts: Mapping[str, FloatArray], q: FloatArray, load: Payload
) -> FloatArray:
    """Return (N, n) the effort of the payload, from the robot model if the prediction has none."""
    if load.is_empty:
        return np.zeros_like(parts["gravity"])
    if "payload" in parts:
        return parts["payload"]
    require_torque(model)
    still = np.zeros_like(q)
    torque: FloatArray = model.robot_.payload_effort(load, q, still, still)
    return torque / model.torque_scale_


def resting_at(model: RobotEstimator, q: FloatArray, load: Payload) -> Dataset:
    """Return positions (N, n) as a prepared dataset of a static arm.

    Raises:
        DataError: The number of positions in `q` differs from the number of joints.
    """
    n = len(model.joint_names_)
    if q.ndim != 2 or q.shape[1] != n:
        raise DataError(f"the model has {n} joints, the positions have the shape {q.shape}")
    still = np.zeros_like(q)
    whole = motion_of(model, np.arange(len(q), dtype=np.float64), q, still, still)
    return replace(whole, conditions=(Conditions("at rest", "dwell", payload=load),))
