"""A motion as data that a model can be asked about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import Conditions, Dataset
from hil.estimators.base import RobotEstimator


def motion_of(
    model: RobotEstimator, t: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> Dataset:
    """One series at times (N,) with motion (N, n), filtered already, nothing mounted, no effort."""
    columns = {"t": t, "q": q, "qd": qd, "effort": np.zeros_like(q)}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": np.zeros_like(q)}
    x, y, z = (float(value) for value in model.robot_.gravity_vector)
    return Dataset(
        robot=model.robot_.name,
        joint_names=model.joint_names_,
        effort_kind="torque" if model.effort_kind_ == "torque" else "current",
        columns=columns,
        offsets=np.array([0, len(t)], dtype=np.int64),
        conditions=(Conditions("asked", "trajectory"),),
        drive_gains=model.torque_scale_,
        gravity=(x, y, z),
    )


def dwells_of(
    model: RobotEstimator, q: FloatArray, load: Payload | None = None, **columns: FloatArray
) -> Dataset:
    """A dwell of one row at each of the positions (N, n), with what else is measured there."""
    still = np.zeros_like(q)
    whole = motion_of(model, np.arange(len(q), dtype=np.float64), q, still, still)
    ids = [f"dwell{k}" for k in range(len(q))]
    mounted: dict[str, Any] = {} if load is None else {"payload": load}
    return replace(
        whole,
        columns={**whole.columns, **columns},
        offsets=np.arange(len(q) + 1),
        conditions=tuple(Conditions(one, "dwell", pose=k, **mounted) for k, one in enumerate(ids)),
    )
