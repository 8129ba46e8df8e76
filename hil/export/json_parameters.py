"""Every number an estimator found that means something, one entry each, for a JSON document."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hil.dynamics import base_parameters
from hil.estimators import (
    FrictionLaw,
    PaperGravity,
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
from hil.export.json_entries import (
    NOT_FITTED,
    NOT_TOLD,
    OUTSIDE,
    Entry,
    Spread,
    entry,
    of_base,
    paper_entry,
    spread_of,
)
from hil.export.json_friction import remembers
from hil.export.json_terms import (
    BENT,
    EXPONENT,
    FORMS,
    LENGTH,
    NETWORK,
    PLAIN,
    SHAPES,
    SQUARE,
    TORQUE,
    Term,
    adapted,
    library_term,
    rest_term,
)
from hil.networks import CorrectedModel, LagrangianModel


def parameters_of(model: RobotEstimator) -> list[Entry]:
    """The parameters of a fitted model, those of the physics for a residual network.

    Kinds of estimators that are not known here have their `coefficients_`, if any, without units.
    """
    if isinstance(model, CorrectedModel):
        return parameters_of(model.base_)
    if isinstance(model, RigidHysteresis):
        return list(_hysteresis(model))
    if isinstance(model, LagrangianModel):
        return list(_lagrangian(model))
    if isinstance(model, RigidLinear):
        return list(_linear(model))
    if isinstance(model, StaticModel):
        return list(_static(model))
    names = [str(name) for name in getattr(model, "parameter_names_", ())]
    values = np.asarray(getattr(model, "coefficients_", ()), dtype=np.float64)
    unknown = Term("", "", "of an estimator that this version of hil does not know")
    told = spread_of(model) if isinstance(model, WlsEstimator) else Spread.none(len(names))
    pairs = enumerate(zip(names, values.tolist(), strict=False))
    return [entry(name, None, "unknown", x, unknown, told.row(k)) for k, (name, x) in pairs]


def torque_unit(model: RobotEstimator) -> str:
    """`A` where currents were fitted without drive gains, as static models may be."""
    return "A" if isinstance(model, StaticModel) and not model.knows_gains else TORQUE


def _own(
    model: RobotEstimator, names: Sequence[str], values: Sequence[float], terms: Mapping[str, Term],
    told: Spread,
) -> Iterator[Entry]:  # fmt: skip
    """Parameters of single joints, named `joint.term`."""
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


def _rest(told: Spread, after: int) -> Spread:
    return Spread(told.std[after:], told.interval[after:], told.reasons[after:])


def _linear(model: RigidLinear) -> Iterator[Entry]:
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
        terms = PLAIN | {"viscous": BENT}
    yield from _own(model, names[b:], values[b:].tolist(), terms, _rest(told, b))
    bent = [f"{joint}.exponent" for joint in model.joint_names_] if exponents else []
    reason = OUTSIDE if getattr(model, "exponent", False) else NOT_FITTED
    yield from _own(model, bent, exponents, {"exponent": EXPONENT}, Spread.none(len(bent), reason))


def _hysteresis(model: RigidHysteresis) -> Iterator[Entry]:
    base, law = base_parameters(model.robot_, rotor=True), model.law_
    none = Spread.none(base.rank)
    yield from of_base(model.robot_, base, model.rigid_, "rigid", none)
    yield from of_base(model.robot_, base, model.gear_rigid_, "gear", none)
    names = law.parameter_names(model.joint_names_)
    values = np.concatenate(law.coefficients).tolist()
    columns = {c for own in law.chosen for g in own for c in column_names(g, law.count(g))}
    terms = {column: library_term(column) for column in columns}
    yield from _own(model, names, values, terms, Spread.none(len(names)))
    yield from _shapes(model, law)


def _shapes(model: RigidHysteresis, law: FrictionLaw) -> Iterator[Entry]:
    for (word, term), row in zip(SHAPES.items(), law.shapes.to_array(), strict=True):
        names = [f"{joint}.{word}" for joint in model.joint_names_]
        reason = NOT_FITTED if word == "turns" else NOT_TOLD
        yield from _own(model, names, row.tolist(), {word: term}, Spread.none(len(names), reason))


def _lagrangian(model: LagrangianModel) -> Iterator[Entry]:
    found = dict(model.intrinsic_)
    terms = dict(NETWORK.get(model.design_.kind, {}))
    if model.length_ is not None and remembers(model):
        terms = {word: _with_state(term) for word, term in terms.items()}
        found["length"], terms["length"] = model.length_, LENGTH
    for word, values in found.items():
        names = [f"{joint}.{word}" for joint in model.joint_names_]
        yield from _own(model, names, values.tolist(), terms, Spread.none(len(names)))


def _with_state(term: Term) -> Term:
    """Dahl's state in the place of the sign."""
    return term._replace(column="z" + term.column[1:]) if term.column[0] == "s" else term


def _static(model: StaticModel) -> Iterator[Entry]:
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
    yield from _own(model, names[g:], values[g:].tolist(), terms, _rest(told, g))
