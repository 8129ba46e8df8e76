"""Parameters of a fitted model as entries with value, unit, uncertainty, column and meaning.

The function `parameters_of` supports every kind of estimator. Base parameters and gravity have the
columns of the regressor; parameters of single joints have the terms of friction (`json_friction`).
The uncertainty of a parameter is the uncertainty that the estimator provides (`Spread`). An entry
without uncertainty contains the reason for the missing uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.dynamics import BaseParameters, RobotModel, base_parameters
from hil.estimators import (
    FrictionLaw,
    PaperGravity,
    RigidClassical,
    RigidDiffnea,
    RigidHysteresis,
    RigidIrls,
    RigidLinear,
    RobotEstimator,
    StaticFriction,
    StaticInverse,
    StaticModel,
    WlsEstimator,
    column_names,
)
from hil.export.json_friction import (
    EXPONENT,
    FORMS,
    LENGTH,
    NETWORK,
    PLAIN,
    POWER_VISCOUS,
    SHAPES,
    SQUARE,
    TORQUE,
    Term,
    adapted,
    library_term,
    remembers,
    rest_term,
)
from hil.networks import LagrangianEstimator, ResidualNetwork

Entry = dict[str, Any]


def parameters_of(model: RobotEstimator) -> list[Entry]:
    """Return the parameters of a fitted model; for a residual network, those of its physics.

    For estimators of unknown kind, the entries of `coefficients_`, if it exists, are returned
    without units.
    """
    if isinstance(model, ResidualNetwork):
        return parameters_of(model.base_)
    if isinstance(model, RigidHysteresis):
        return list(_of_hysteresis(model))
    if isinstance(model, LagrangianEstimator):
        return list(_of_lagrangian(model))
    if isinstance(model, RigidLinear):
        return list(_of_rigid_linear(model))
    if isinstance(model, StaticModel):
        return list(_of_static(model))
    names = [str(name) for name in getattr(model, "parameter_names_", ())]
    values = np.asarray(getattr(model, "coefficients_", ()), dtype=np.float64)
    unknown = Term("", "", "of an estimator that is unknown to this version of hil")
    told = spread_of(model) if isinstance(model, WlsEstimator) else Spread.none(len(names))
    pairs = enumerate(zip(names, values.tolist(), strict=False))
    return [entry(name, None, "unknown", x, unknown, told.row(k)) for k, (name, x) in pairs]


def _of_hysteresis(model: RigidHysteresis) -> Iterator[Entry]:
    base, law = base_parameters(model.robot_, rotor=True), model.law_
    none = Spread.none(base.rank)
    yield from of_base(model.robot_, base, model.rigid_, "rigid", none)
    yield from of_base(model.robot_, base, model.gear_rigid_, "gear", none)
    names = law.parameter_names(model.joint_names_)
    values = np.concatenate(law.coefficients).tolist()
    columns = {c for own in law.chosen for g in own for c in column_names(g, law.count(g))}
    terms = {column: library_term(column) for column in columns}
    yield from _of_joints(model, names, values, terms, Spread.none(len(names)))
    yield from _of_shapes(model, law)


def _of_joints(
    model: RobotEstimator, names: Sequence[str], values: Sequence[float], terms: Mapping[str, Term],
    told: Spread,
) -> Iterator[Entry]:  # fmt: skip
    """Yield the parameters of single joints, whose names are `joint.term`."""
    torque = torque_unit(model)
    for k, (name, value) in enumerate(zip(names, values, strict=True)):
        joint = max((j for j in model.joint_names_ if name.startswith(f"{j}.")), key=len)
        word = name.removeprefix(f"{joint}.")
        term = terms[word]
        slides = not model.robot_.joint_geometry().turns[model.joint_names_.index(joint)]
        unit = adapted(term.unit, slides=slides, torque=torque)
        whole = Term(unit, term.column, term.meaning)
        yield entry(name, joint, _group(word, term), value, whole, told.row(k))


def _group(word: str, term: Term) -> str:
    if term.column in ("α", "δ", "vs", "x0", "p", "N"):
        return "shape"
    if word in ("gain", "square", "current_squared", "drive"):
        return "drive"
    kind = word[:6]
    return kind if kind in ("offset", "ripple") else "friction"


NOT_FITTED = "set by the user, not fitted"
NOT_TOLD = (
    "the estimator computes no uncertainty of single parameters; see sigma for that of predictions"
)


def _of_shapes(model: RigidHysteresis, law: FrictionLaw) -> Iterator[Entry]:
    for (word, term), row in zip(SHAPES.items(), law.shapes.to_array(), strict=True):
        names = [f"{joint}.{word}" for joint in model.joint_names_]
        reason = NOT_FITTED if word == "turns" else NOT_TOLD
        yield from _of_joints(
            model, names, row.tolist(), {word: term}, Spread.none(len(names), reason)
        )


def _of_lagrangian(model: LagrangianEstimator) -> Iterator[Entry]:
    found = dict(model.intrinsic_)
    terms = dict(NETWORK.get(model.design_.kind, {}))
    if model.length_ is not None and remembers(model):
        terms = {word: _with_state(term) for word, term in terms.items()}
        found["length"], terms["length"] = model.length_, LENGTH
    for word, values in found.items():
        names = [f"{joint}.{word}" for joint in model.joint_names_]
        yield from _of_joints(model, names, values.tolist(), terms, Spread.none(len(names)))


def _with_state(term: Term) -> Term:
    """Return the term with Dahl's state in place of the sign."""
    return term._replace(column="z" + term.column[1:]) if term.column[0] == "s" else term


OUTSIDE = (
    "not fitted by least squares; the standard errors of the other parameters do not "
    "include its uncertainty"
)


def _of_rigid_linear(model: RigidLinear) -> Iterator[Entry]:
    base, told = base_parameters(model.robot_, rotor=True), spread_of(model)
    values, names, b = model.coefficients_, model.parameter_names_, base.rank
    yield from of_base(model.robot_, base, values[:b], "rigid", told)
    terms: Mapping[str, Term] = PLAIN
    if isinstance(model, RigidDiffnea):
        terms = FORMS[model.friction]
        gear = Spread.none(b)
        if model.friction == "memory":
            yield from of_base(model.robot_, base, model.gear_rigid_, "gear", gear)
    exponents = model.exponent_.tolist() if isinstance(model, RigidIrls) else []
    if exponents:
        terms = PLAIN | {"viscous": POWER_VISCOUS}
    yield from _of_joints(model, names[b:], values[b:].tolist(), terms, told.after(b))
    bent = [f"{joint}.exponent" for joint in model.joint_names_] if exponents else []
    reason = OUTSIDE if getattr(model, "exponent", False) else NOT_FITTED
    yield from _of_joints(
        model, bent, exponents, {"exponent": EXPONENT}, Spread.none(len(bent), reason)
    )


def _of_static(model: StaticModel) -> Iterator[Entry]:
    told, names, values = spread_of(model), model.parameter_names_, model.coefficients_
    words = {
        name.rpartition(".")[2] for name in names if name.partition(".")[0] in model.joint_names_
    }
    terms = {word: rest_term(word) for word in words}
    if model.form == "paper":
        g, torque = len(PaperGravity.names), torque_unit(model)
        for k, name in enumerate(PaperGravity.names):
            yield paper_entry(model, name, float(values[k]), torque, told.row(k))
    else:
        base = base_parameters(model.robot_, gravity_only=True)
        g = base.rank
        yield from of_base(model.robot_, base, values[:g], "gravity", told)
        if isinstance(model, StaticFriction) and any("τ" in one.column for one in terms.values()):
            yield from of_base(model.robot_, base, model.load_gravity_, "gear", Spread.none(g))
    if isinstance(model, StaticInverse):
        terms["square"] = SQUARE
    yield from _of_joints(model, names[g:], values[g:].tolist(), terms, told.after(g))


def torque_unit(model: RobotEstimator) -> str:
    """Return `A` for a static model fitted to currents without drive gains, else `N·m`."""
    return "A" if isinstance(model, StaticModel) and not model.knows_gains else TORQUE


def entry(
    name: str,
    joint: str | None,
    group: str,
    value: float,
    term: Term,
    known: tuple[float, list[float], str] = (np.nan, [np.nan, np.nan], NOT_TOLD),
    **more: Any,
) -> Entry:
    """Return one parameter as an entry, in which unknown values are null and have a reason."""
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


def of_base(
    robot: RobotModel, base: BaseParameters, values: np.ndarray[Any, Any], group: str, told: Spread
) -> Iterator[Entry]:
    """Yield base parameters, each with its regressor column and its combination of parameters."""
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
        more = (
            " and all parameters that torques cannot distinguish from it" if len(sums) > 1 else ""
        )
        term = Term(unit, column, meaning.format(link) + more)
        yield entry(
            base.names[k], robot.joint_names[joint], group, float(values[k]), term, told.row(k),
            combination=sums,
        )  # fmt: skip


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
"""Factors of each term of eq. 15, static paper: sine or cosine of a sum of joint angles."""


def paper_entry(
    model: StaticModel, name: str, value: float, torque: str, known: tuple[float, list[float], str]
) -> Entry:
    """Return the entry for one parameter of eq. 15, by its name in `PaperGravity`."""
    joint = model.joint_names_[int(name[5]) - 1]
    waves = PAPER[name]
    text = "·".join(f"{f}({'+'.join(f'q{i}' for i in joints)})" for f, joints in waves)
    term = Term(torque, text, "coefficient of gravity, eq. 15 of the static paper")
    return entry(name, joint, "gravity", value, term, known, waves=waves)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Uncertainty of p coefficients.

    Attributes:
        std: (p,) standard errors; NaN if unknown.
        interval: (p, 2) lower and upper limits of the 95 % confidence intervals; NaN if unknown.
        reasons: List of p reasons for missing values, each empty if no value is missing.
    """

    std: FloatArray
    interval: FloatArray
    reasons: tuple[str, ...]

    @staticmethod
    def none(p: int, reason: str = NOT_TOLD) -> Spread:
        """Return an unknown uncertainty of p parameters, with a reason."""
        return Spread(np.full(p, np.nan), np.full((p, 2), np.nan), (reason,) * p)

    def after(self, k: int) -> Spread:
        """Return the uncertainty of the coefficients from number k on."""
        return Spread(self.std[k:], self.interval[k:], self.reasons[k:])

    def row(self, k: int) -> tuple[float, list[float], str]:
        """Return standard error, interval and reason of one coefficient."""
        return float(self.std[k]), self.interval[k].tolist(), self.reasons[k]


NO_DEGREES = "the estimator computes standard errors, but no degrees of freedom for an interval"

NOT_OF_METHOD = (
    "least squares has no covariance for bounds, penalties and fitted exponents; std is that of "
    "least squares without them"
)

NOT_ESTIMATED = "excluded from the fit: the value is 0"
PULLED = "biased by a penalty or by noise in the columns, by more than the scatter shows"


def spread_of(model: RobotEstimator) -> Spread:
    """Return the uncertainty of `coefficients_`, from `std_error_` and `interval` of the model."""
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
    """Return the assumptions and limits of the standard errors, as `model.json` contains them."""
    told = model.fitted_facts().get("std_error")
    if not isinstance(told, dict):
        return None
    keys = ("given", "leaves_out", "method", "correlated_samples")
    return {key: told.get(key) for key in keys}
