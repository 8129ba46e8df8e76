"""Entries of a JSON document: bodies and gravity, and how sure a model is of its coefficients.

Uncertainty is what the estimator itself tells, and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.dynamics import BaseParameters, RobotModel
from hil.estimators import RigidClassical, RobotEstimator, StaticInverse, StaticModel, WlsEstimator
from hil.export.json_terms import Term

Entry = dict[str, Any]

NO_DEGREES = "the estimator tells standard errors, but no degrees of freedom for an interval"
NOT_OF_METHOD = (
    "bounds, penalties and fitted exponents have no covariance of least squares; std is that of "
    "least squares without them"
)
PULLED = "a penalty, or noise in the columns, pulls by more than any scatter tells"
NOT_TOLD = "the estimator tells no uncertainty of single parameters; see sigma for predictions"
OUTSIDE = "its uncertainty is not in the standard errors of the others either"
NOT_FITTED = "given, not fitted"
NOT_ESTIMATED = "left out of the fit: its value is 0"


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Of p coefficients.

    Attributes:
        std: (p,) standard errors; NaN where there is none.
        interval: (p, 2) ends of 95 %; NaN where there is none.
        reasons: Length p, why something is missing; empty where nothing is.
    """

    std: FloatArray
    interval: FloatArray
    reasons: tuple[str, ...]

    @staticmethod
    def none(p: int, reason: str = NOT_TOLD) -> Spread:
        """Nothing known of p parameters."""
        return Spread(np.full(p, np.nan), np.full((p, 2), np.nan), (reason,) * p)

    def row(self, k: int) -> tuple[float, list[float], str]:
        """Standard error, interval and reason of one coefficient."""
        return float(self.std[k]), self.interval[k].tolist(), self.reasons[k]


def spread_of(model: RobotEstimator) -> Spread:
    """Of `coefficients_`, as `std_error_` and `interval` of the model say it."""
    if not isinstance(model, WlsEstimator):
        return Spread.none(0)
    std, missing = np.asarray(model.std_error_), ""
    interval = np.full((len(std), 2), np.nan)
    own = getattr(model, "interval", None)
    if own is None:
        missing = NO_DEGREES
    elif isinstance(model, RigidClassical) and not model.certain:
        missing = NOT_OF_METHOD
    else:
        interval = np.asarray(own(0.95))
    none = NOT_ESTIMATED if isinstance(model, StaticInverse) else PULLED
    reasons = tuple(
        none if not np.isfinite(std[k]) else "" if np.all(np.isfinite(interval[k])) else missing
        for k in range(len(std))
    )
    return Spread(std, interval, tuple(reason or "" for reason in reasons))


def conditions_of(model: RobotEstimator) -> dict[str, Any] | None:
    """What standard errors take for granted and leave out, as `model.json` has it."""
    told = model.fitted_facts().get("std_error")
    if not isinstance(told, dict):
        return None
    keys = ("given", "leaves_out", "method", "correlated_samples")
    return {key: told.get(key) for key in keys}


BODY = {
    "m": ("kg", "mass of link {}"),
    "mx": ("kg·m", "mass times x of the centre of mass of link {}"),
    "my": ("kg·m", "mass times y of the centre of mass of link {}"),
    "mz": ("kg·m", "mass times z of the centre of mass of link {}"),
    "Ixx": ("kg·m²", "moment of inertia xx of link {} about its joint frame's origin"),
    "Ixy": ("kg·m²", "product of inertia xy of link {} about its joint frame's origin"),
    "Iyy": ("kg·m²", "moment of inertia yy of link {} about its joint frame's origin"),
    "Ixz": ("kg·m²", "product of inertia xz of link {} about its joint frame's origin"),
    "Iyz": ("kg·m²", "product of inertia yz of link {} about its joint frame's origin"),
    "Izz": ("kg·m²", "moment of inertia zz of link {} about its joint frame's origin"),
    "Ia": ("kg·m²", "rotor inertia of joint {}, reflected to the joint"),
}

PAPER = {
    "joint2.phi1": (("cos", (2, 3)), ("cos", (4,)), ("sin", (5,))),
    "joint2.phi2": (("cos", (2, 3)), ("sin", (4,))),
    "joint2.phi3": (("cos", (2, 3)),),
    "joint2.phi4": (("cos", (2,)),),
    "joint2.phi5": (("sin", (2, 3)), ("sin", (4,)), ("sin", (5,))),
    "joint2.phi6": (("sin", (2, 3)), ("cos", (4,))),
    "joint3.phi1": (("sin", (2, 3, 4)),),
    "joint3.phi2": (("cos", (2, 3)),),
    "joint3.phi3": (("cos", (2, 3, 4)), ("sin", (5,))),
    "joint4.phi1": (("sin", (2, 3, 4)),),
    "joint4.phi2": (("cos", (2, 3, 4)), ("sin", (5,))),
    "joint5.phi1": (("sin", (2, 3, 4)), ("cos", (5,))),
}
"""Eq. 15 of the static paper as products of waves of sums of joint angles, from 1."""


def entry(
    name: str,
    joint: str | None,
    group: str,
    value: float,
    term: Term,
    known: tuple[float, list[float], str] = (np.nan, [np.nan, np.nan], NOT_TOLD),
    **more: Any,
) -> Entry:
    """One parameter; what is not known is null, with the reason beside it."""
    std, interval, reason = known
    return {
        "name": name,
        "joint": joint,
        "group": group,
        "value": value,
        "unit": term.unit,
        "std": std,
        "interval_95": interval if np.all(np.isfinite(interval)) else None,
        "reason": reason or None,
        "column": term.column,
        "meaning": term.meaning,
        **more,
    }


def of_base(
    robot: RobotModel, base: BaseParameters, values: np.ndarray[Any, Any], group: str, told: Spread
) -> Iterator[Entry]:
    """Base parameters: the column each is multiplied with, and what it is a sum of."""
    columns = robot.parameter_names(rotor=True)
    turns = robot.joint_geometry().turns
    for k, kept in enumerate(base.independent):
        column = columns[kept]
        kind, _, link = column.partition("_")
        joint = int(link) - 1
        unit, meaning = BODY[kind]
        folded = zip(base.dependent, base.combination[k], strict=True)
        sums = {column: 1.0} | {columns[i]: float(share) for i, share in folded if share}
        unit = "kg" if kind == "Ia" and not turns[joint] else unit
        more = " with all that torques cannot tell from it" if len(sums) > 1 else ""
        term = Term(unit, column, meaning.format(link) + more)
        yield entry(
            base.names[k], robot.joint_names[joint], group, float(values[k]), term, told.row(k),
            combination=sums,
        )  # fmt: skip


def paper_entry(
    model: StaticModel, name: str, value: float, torque: str, known: tuple[float, list[float], str]
) -> Entry:
    """One of eq. 15's parameters, by the name that `PaperGravity` has for it."""
    joint = model.joint_names_[int(name[5]) - 1]
    waves = PAPER[name]
    text = "·".join(f"{f}({'+'.join(f'q{i}' for i in joints)})" for f, joints in waves)
    term = Term(torque, text, "coefficient of gravity, eq. 15 of the static paper")
    return entry(name, joint, "gravity", value, term, known, waves=waves)
