"""A model judged under the load of a recording, and that load checked.

Of one recording there is no other motion to identify its load from: each half of every series is
predicted with the load that the other half tells.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, HilError
from hil.data import Dataset
from hil.estimators import (
    Declaration,
    PayloadEstimate,
    RobotEstimator,
    check_declarations,
    estimate_payload,
    halves,
    payload_halves,
    with_identified,
)
from hil.evaluation.evaluation import filtered_effort


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoad:
    """What a model is worth on a recording with a load that it was not fitted with, or a wrong one.

    Attributes:
        declared: The load, as the recording declares it.
        new: Whether the model was fitted without it; None where nobody knows.
        rmse: (n,) against the filtered effort, where nobody tells the model of the load
            (`unaware`), as `declared`, and as the other half of the recording tells (`identified`;
            not there where it does not).
        estimate: The load by all of the recording; None where it does not tell.
        check: The declaration against it.
        unexplained: What contradicts it unless the drive gains are wrong; nothing where it agrees
            whatever they are.
        failed: Why there is none.
    """

    declared: Payload
    new: bool | None
    rmse: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    check: Declaration | None = None
    unexplained: tuple[str, ...] = ()
    failed: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Part of the contract of `hil fit --json` and `hil evaluate --json`."""
        found, check = self.estimate, self.check
        return {
            "declared": {"mass_kg": self.declared.mass, "com_m": list(self.declared.com)},
            "new": self.new,
            "rmse": {
                told: [value if math.isfinite(value) else None for value in error.tolist()]
                for told, error in self.rmse.items()
            },
            "identified": None if found is None else found.to_dict()["payload"],
            "mass_std_kg": None if found is None else float(found.std_error[0]),
            "agrees": None if check is None else check.agrees,
            "contradictions": [] if check is None else [one.text for one in check.findings],
            "unless_gains_are_wrong": list(self.unexplained),
            "mass_limit_kg": None if check is None else float(check.limit[0]),
            "mount_observable": None if check is None else check.mount_observable,
            "failed": self.failed,
        }


def under_load(
    model: RobotEstimator, data: Dataset, known: Collection[Payload] | None
) -> UnderLoad | None:
    """Judge a model under the load of a recording.

    Args:
        model: Of the arm.
        data: The recording, as measured.
        known: Loads it was fitted with; None where nobody knows.

    Returns:
        None where there is nothing to tell: the arm rests, the loads are several, or it is a load
        that the model knows (nothing, where nobody knows) and the recording does not contradict it.
    """
    loads = {condition.payload for condition in data.conditions}
    moving = all(condition.kind == "trajectory" for condition in data.conditions)
    if len(loads) != 1 or not moving:
        return None
    (declared,) = loads
    usual = declared.is_empty if known is None else declared in known
    new = None if known is None else not usual
    try:
        estimate = estimate_payload(model, data)
        (check,) = check_declarations([declared], [estimate])
        if usual and check.agrees:
            return None
        rmse = _errors(model, data, declared)
        rmse["identified"] = _error(data, _by_halves(model, data))
    except HilError as error:
        if usual:
            return None
        return UnderLoad(declared, new, _errors(model, data, declared), failed=error.message)
    sure = replace(estimate, by_gain=np.zeros_like(estimate.by_gain))
    (surely,) = check_declarations([declared], [sure])
    told = tuple(one.text for one in surely.findings) if check.agrees else ()
    return UnderLoad(declared, new, rmse, estimate, check, told)


def _errors(model: RobotEstimator, data: Dataset, declared: Payload) -> dict[str, FloatArray]:
    return {
        "unaware": _error(data, _effort(model, data, Payload())),
        "declared": _error(data, _effort(model, data, declared)),
    }


def _by_halves(model: RobotEstimator, data: Dataset) -> FloatArray:
    """(N, n) effort of every half with the load that the other tells; friction is the model's."""
    by_first, by_second = (
        _effort(model, data, half.estimate.payload) for half in payload_halves(model, data)
    )
    first, _ = halves(data)
    return np.where(first[:, None], by_second, by_first)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """(N, n) effort; NaN where the model does not vouch for it."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _error(data: Dataset, effort: FloatArray) -> FloatArray:
    """(n,) RMSE over what the model vouches for; NaN for a joint of which it does so nowhere."""
    error = filtered_effort(data) - effort
    known = np.isfinite(error)
    count = np.count_nonzero(known, axis=0)
    total = np.sum(np.where(known, error, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
