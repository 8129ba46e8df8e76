"""A fitted model as one JSON document: parameters with units and how sure they are.

A document has the robot, the effort the model predicts, every number that the estimator found and
that means something (an `Entry` each, by `parameters_of`), the law of friction they belong to, and
what networks add. Uncertainty is what the estimator itself tells, and nothing else; what is not
known is null, with the reason beside it.

A parameter's `column` is what it is multiplied with to give a torque. Columns of friction are
formulas, and `hil.export.json_reader` computes them as they stand in the tables of `Term` at the
end of this module. In them v is the joint's velocity, s the smooth sign of it, z Dahl's state in
place of that sign (z10: with ten times the length), τ the torque through the gear, T the joint's
temperature.

Before a document is written, `hil.export.json_check` computes the model's torques from it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hil.core import FitError, FloatArray, json_document
from hil.dynamics import BaseParameters, RobotModel, about_centre, base_parameters
from hil.estimators import (
    LEAST_SPEED,
    MODEL_FILE,
    NARROWEST,
    REFERENCE_C,
    RIPPLE_FADES_RAD_S,
    FrictionLaw,
    PaperGravity,
    RigidClassical,
    RigidDiffnea,
    RigidHysteresis,
    RigidIrls,
    RigidLinear,
    RobotEstimator,
    StaticFriction,
    StaticHysteresis,
    StaticInverse,
    StaticModel,
    WlsEstimator,
    column_names,
    model_files,
)
from hil.export.exported import Exported, effort_unit, require_new, write_file
from hil.export.json_check import checked
from hil.export.program import LEAST_NETWORK_SPEED, flange_in_last_joint
from hil.networks import LagrangianEstimator, ResidualNetwork, StaticMlpLm

FORMAT = 1
"""Grows when a reader of older documents would misread a new one."""


def export_json(model: RobotEstimator, out: Path) -> Exported:
    """Write the parameters of a model, after its torques were computed from them.

    Args:
        model: Fitted.
        out: File to be made.

    Raises:
        FitError: The model is not fitted, or what the document says is not what the model says.
        RecordingError: The file exists already, or cannot be made.
    """
    require_new(out)
    document = document_of(model)
    write_file(json_document(document), out)
    joints, unit = model.joint_names_, document["effort"]["unit"]
    count = len(document["parameters"])
    told = sum(one["std"] is not None for one in document["parameters"])
    parts = f"{model.estimator}, {count} parameters, {told} with standard errors"
    return Exported(out, (out.name,), joints, unit, parts, document["checked"], model.notes_)


def document_of(model: RobotEstimator) -> dict[str, Any]:
    """The document of a fitted model, as it is read back.

    Raises:
        FitError: As `export_json`.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    physics = model.base_ if isinstance(model, ResidualNetwork) else model
    parts = {
        "hil_export": FORMAT,
        "model": model_part(model),
        "robot": robot_part(model.robot_),
        "effort": effort_part(model),
        "sigma": sigma_part(model),
        "std_errors": conditions_of(physics),
        "parameters": parameters_of(model),
        "friction": friction_part(model),
        "links": links_part(model),
        "networks": networks_part(model),
    }
    document: dict[str, Any] = json.loads(json_document(parts))
    return document | {"checked": checked(model, document)}


CHOICE = (
    "one set of links that can exist and has these torques: a single link's mass is a choice among "
    "many, only the base parameters were measured"
)
NO_LINKS = "the estimator knows sums of inertial parameters only, not those of single links"

GAINS_UNKNOWN = (
    "the model knows where its gains come from, not how sure they are; hil gains tells that"
)
NO_GAINS = "fitted to currents without drive gains: what others have in N·m is told in A, 1 A per A"
A_TORQUE = "efforts are torques"


def model_part(model: RobotEstimator) -> dict[str, Any]:
    """What found the parameters, with what settings and from what, as `model.json` says it."""
    stored = json.loads(model_files(model)[MODEL_FILE])
    filters = getattr(model, "filters_", None) or getattr(model, "filters", None)
    return {
        "estimator": model.estimator,
        "protocol": model.protocol,
        "settings": stored["parameters"],
        "filters": filters,
        "samples": model.samples_,
        "condition": getattr(model, "condition_", None),
        "training": stored["training"],
        "fingerprint_sha256": stored["arrays_sha256"],
        "physics": model.base_.estimator if isinstance(model, ResidualNetwork) else None,
        "notes": list(model.notes_),
    }


def robot_part(robot: RobotModel) -> dict[str, Any]:
    """Joints as placements, so that a reader needs no other description of the arm."""
    geometry, described = robot.joint_geometry(), robot.to_dict()
    coupling = getattr(robot, "joints_per_motor", None)
    joints = [
        {
            "name": name,
            "type": "revolute" if geometry.turns[j] else "prismatic",
            "placement": geometry.placement[j],
            "axis": geometry.axis[j],
            "position_min": robot.q_min[j],
            "position_max": robot.q_max[j],
            "speed_max": robot.qd_max[j],
            "torque_max": robot.effort_max[j],
        }
        for j, name in enumerate(robot.joint_names)
    ]
    return {
        # A path says where somebody keeps files, not what robot it is.
        "name": Path(robot.name).name,
        "gravity_m_s2": robot.gravity_vector,
        "joints": joints,
        "joints_per_motor": coupling,
        "flange": {"name": described["flange"], "placement": flange_in_last_joint(robot)},
    }


def effort_part(model: RobotEstimator) -> dict[str, Any]:
    """Kind and unit of what the model predicts, and the torque that one unit of it is."""
    unit, torque = effort_unit(model.effort_kind_), torque_unit(model)
    known = not (torque == "A" and unit == "A")
    reason = (GAINS_UNKNOWN if known else NO_GAINS) if unit == "A" else A_TORQUE
    return {
        "kind": model.effort_kind_,
        "unit": unit,
        "torque_per_effort": {
            "values": model.torque_scale_ if known else None,
            "unit": f"{torque}/{unit}" if unit == "A" else "1",
            "source": model.gains_source_ or None,
            "std": None,
            "reason": reason,
        },
    }


def sigma_part(model: RobotEstimator) -> dict[str, Any]:
    """How far predictions are off, joint by joint."""
    bands = getattr(model, "bands_", None)
    return {
        "values": model.sigma_,
        "unit": effort_unit(model.effort_kind_),
        "meaning": _sigma_of(model),
        "bands": bands
        and {
            "asked": bands.asked,
            "speed_edges_rad_s": bands.edges,
            "half_widths": bands.half_widths,
            "guaranteed": bands.guaranteed,
        },
    }


def _sigma_of(model: RobotEstimator) -> str:
    if isinstance(model, RigidHysteresis | ResidualNetwork | LagrangianEstimator):
        return "root mean square error on trajectories that were left out of the fit"
    if isinstance(model, StaticMlpLm):
        return "root mean square error at poses held out of the training, if there were any"
    if isinstance(model, StaticHysteresis) and len(model.penalty_):
        return "root mean square error on poses that the correction had not seen"
    return "standard deviation of the training residual"


def links_part(model: RobotEstimator) -> dict[str, Any]:
    """Full inertial parameters of links that can exist, where the model has them."""
    physics = getattr(model, "base_", model)
    inertial = getattr(physics, "inertial_", None)
    if inertial is None:
        return {"values": None, "reason": NO_LINKS, "note": None}
    n, names = physics.robot_.n, physics.joint_names_
    rows = zip(names, inertial[: 10 * n].reshape(n, 10), inertial[10 * n :], strict=True)
    return {"values": [_link(*row) for row in rows], "reason": None, "note": CHOICE}


def _link(joint: str, body: np.ndarray[Any, Any], rotor: float) -> dict[str, Any]:
    mass, com, inertia = about_centre(body)
    return {
        "joint": joint,
        "mass_kg": mass,
        "com_m": com,
        "inertia_kgm2": inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        "rotor_inertia_kgm2": rotor,
    }


def parameters_of(model: RobotEstimator) -> list[Entry]:
    """The parameters of a fitted model, those of the physics for a residual network.

    Kinds of estimators that are not known here have their `coefficients_`, if any, without units.
    """
    if isinstance(model, ResidualNetwork):
        return parameters_of(model.base_)
    if isinstance(model, RigidHysteresis):
        return list(_hysteresis(model))
    if isinstance(model, LagrangianEstimator):
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


def _lagrangian(model: LagrangianEstimator) -> Iterator[Entry]:
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


STORED = "model.safetensors"

SUM = "sum of value × column over the joint's parameters"
SMOOTH = "s = tanh(v/sign_width_rad_s), the sign of v for 0"
DAHL = (
    "z: at first 0; from sample to sample z ← σ + (z − σ)·exp(−|Δq|/x0), σ the sign of Δq, where "
    "Δq·v > 0; elsewhere, and so for v = 0, z stays; z3, z10, …: with 3, 10, … times x0"
)
V0 = "v0 = least_speed_rad_s"
SYMBOLS = "vf = ripple_fades_rad_s; T0 = reference_celsius; T = usual_celsius (T0 without)"
AT_REST = (
    "d: +1 approached from below, −1 from above; z1, z2, …: Dahl's states with lengths_rad along "
    "the smoothed path into the pose; τ: the group gear and load, within load_limit_nm; "
    "N = gear_ratio; Tm = mean_celsius"
)


def friction_part(model: RobotEstimator) -> dict[str, Any]:
    """The law behind the parameters: its name, its formula and its constants."""
    if isinstance(model, ResidualNetwork):
        return friction_part(model.base_)
    if isinstance(model, RigidHysteresis):
        constants = {"reference_celsius": REFERENCE_C, "ripple_fades_rad_s": RIPPLE_FADES_RAD_S}
        usual = {"usual_celsius": model.law_.celsius}
        return _law("library", f"{SUM}; {DAHL}; {SYMBOLS}", True, constants | usual)
    if isinstance(model, LagrangianEstimator):
        return _network_law(model)
    if isinstance(model, RigidDiffnea):
        memory, width = model.friction == "memory", {"sign_width_rad_s": model.sign_width}
        words = f"{SUM}; {SMOOTH}; {V0}" + f"; {DAHL}" * memory
        return _law(model.friction, words, memory, width | {"least_speed_rad_s": LEAST_SPEED})
    if isinstance(model, RigidLinear):
        constants = {"sign_width_rad_s": model.sign_width}
        if not isinstance(model, RigidIrls):
            return _law("coulomb-viscous", f"{SUM}; {SMOOTH}", False, constants)
        constants["power_width_rad_s"] = model.sign_width or NARROWEST
        words = f"{SUM}; {SMOOTH}; w = power_width_rad_s"
        return _law("coulomb-viscous", words, False, constants)
    if isinstance(model, StaticFriction):
        return _at_rest(model)
    noise = "friction at rest counts as noise"
    if isinstance(model, StaticInverse):
        solved = "gravity = K2·i·|i| + K1·i + K0, solved for the current i; offset is −K0"
        return _law("none", f"{solved}; {noise}", False, {})
    if isinstance(model, StaticMlpLm):
        return _law("network", f"{SUM}; friction at rest is what the networks say", False, {})
    if isinstance(model, StaticModel):
        return _law("none", f"{SUM}; {noise}", False, {})
    return _law("unknown", "of an estimator that this version of hil does not know", False, {})


def _law(
    name: str, formula: str, memory: bool, constants: dict[str, Any], **more: Any
) -> dict[str, Any]:
    base = {"law": name, "formula": formula, "memory": memory, "constants": constants}
    return base | {"level_nm": more.get("level_nm")}


def remembers(model: LagrangianEstimator) -> bool:
    """Whether friction has Dahl's state for the sign of the velocity."""
    return model.length_ is not None and model.design_.friction.sign != "hard"


def _network_law(model: LagrangianEstimator) -> dict[str, Any]:
    kind, hard = model.design_.kind, model.design_.friction.sign == "hard"
    if kind not in NETWORK:
        return _law(kind, f"{kind}: no parameters that mean anything", False, {})
    constants = {} if remembers(model) else {"sign_width_rad_s": 0.0 if hard else model.sign_width}
    sign = DAHL if remembers(model) else SMOOTH
    if kind == "stribeck":
        constants["least_speed_rad_s"] = LEAST_NETWORK_SPEED
        sign = f"{sign}; {V0}"
    return _law(kind, f"{SUM}; {sign}", remembers(model), constants)


def _at_rest(model: StaticFriction) -> dict[str, Any]:
    constants: dict[str, Any] = {
        "load_limit_nm": model.load_limit_,
        "mean_celsius": model.celsius_,
    }
    if isinstance(model, StaticHysteresis):
        constants["lengths_rad"] = model.lengths_rad
        constants["gear_ratio"] = model.gear_ratio
    return _law("rest", f"{SUM}; {AT_REST}", True, constants, level_nm=model.dry_friction())


def networks_part(model: RobotEstimator) -> list[dict[str, Any]]:
    """What was learnt that no single number tells: sizes, and where the weights lie."""
    if isinstance(model, ResidualNetwork):
        return [_residual(model), *networks_part(model.base_)]
    if isinstance(model, LagrangianEstimator):
        weights = sum(int(w.size) for w in model.weights_.values() if w.dtype.kind == "f")
        what = "inertia matrix and potential of the arm, and friction where it is a network"
        inputs = ["q", "qd", "qdd", "direction"]
        return [_network(what, 1, weights, "network.", inputs, model.design_.facts(), model)]
    if isinstance(model, StaticMlpLm):
        mlp = model.networks_.mlp
        layout = {"layers": list(mlp.layers), "activations": list(mlp.activations)}
        n, weights = len(model.joint_names_), int(model.networks_.weights.size)
        what = "friction at rest, one network per joint"
        return [_network(what, n, weights, "network.", list(model.inputs), layout, model)]
    if isinstance(model, StaticHysteresis) and len(model.penalty_):
        arrays = model.fitted_arrays()
        weights = int(np.size(arrays["correction_weights"]))
        what = "linear correction of friction by the path into the pose, one per joint"
        inputs = ["path", "load", "temperature"]
        layout = {"penalty": model.penalty_}
        return [_network(what, len(model.penalty_), weights, "correction_", inputs, layout, model)]
    return []


def _residual(model: ResidualNetwork) -> dict[str, Any]:
    correction = model.correction_
    first = correction.networks[0]
    weights = sum(
        int(np.size(values)) for one in correction.networks
        for values in one.weights.to_arrays().values()
    )  # fmt: skip
    inputs = ["q", "qd", "qdd"] + (
        [] if correction.settings.inputs == "motion" else ["measured torque"]
    )
    layout = correction.settings.to_json() | {
        "rate_hz": first.rate_hz,
        "window_samples": correction.settings.window,
    }
    what = "what the physics leaves in motion, in effort units: the mean of the networks"
    told = _network(what, len(correction.networks), weights, "network", inputs, layout, model)
    kept = zip(model.joint_names_, correction.kept, strict=True)
    return told | {"joints": [name for name, own in kept if own], "limit": correction.limit}


def _network(
    what: str, count: int, weights: int, arrays: str, inputs: list[str], layout: dict[str, Any],
    model: RobotEstimator,
) -> dict[str, Any]:  # fmt: skip
    return {
        "what": what,
        "count": count,
        "weights": weights,
        "stored_in": STORED,
        "arrays": f"{arrays}*",
        "inputs": inputs,
        "layout": layout,
        "joints": list(model.joint_names_),
        "limit": None,
    }


TORQUE, DAMPING = "N·m", "N·m·s/rad"


class Term(NamedTuple):
    """A parameter of a joint.

    Attributes:
        unit: Of a joint that turns, with torques in N·m; see `adapted`.
        column: What it is multiplied with to give a torque, or what it is.
        meaning: In words.
    """

    unit: str
    column: str
    meaning: str


COULOMB = Term(TORQUE, "s", "Coulomb friction")
VISCOUS = Term(DAMPING, "v", "viscous friction")
OFFSET = Term(TORQUE, "1", "constant: bias of drive or sensor, other friction one way")
STATIC = Term(TORQUE, "s", "static friction: that of a joint which hardly moves")
POWER = Term("N·m·(s/rad)^α", "s·(|v| + v0)^α", "friction that grows with a power of speed")
EXPONENT = Term("1", "α", "exponent α of the speed")
STRIBECK_SPEED = Term("rad/s", "vs", "speed at which static has given way to Coulomb friction")
STRIBECK_SHAPE = Term("1", "δ", "how abruptly it does")
LENGTH = Term("rad", "x0", "way in which Dahl's state comes round")

PLAIN = {"coulomb": COULOMB, "viscous": VISCOUS, "offset": OFFSET}
"""Of `rigid-wls` and its kin."""

BENT = Term("N·m·(s/rad)^α", "v·(v² + w²)^((α − 1)/2)", "friction that grows with a power of speed")
"""Viscous friction of `rigid-irls`."""

FORMS: dict[str, Mapping[str, Term]] = {
    "coulomb-viscous": PLAIN,
    "stribeck": PLAIN
    | {
        "coulomb": Term(TORQUE, "s·(1 − exp(−((|v| + v0)/vs)^δ))", "Coulomb friction"),
        "static": Term(TORQUE, "s·exp(−((|v| + v0)/vs)^δ)", STATIC.meaning),
        "stribeck_velocity": STRIBECK_SPEED,
        "stribeck_exponent": STRIBECK_SHAPE,
    },
}
FORMS["stribeck-power"] = {**FORMS["stribeck"], "viscous": POWER, "speed_exponent": EXPONENT}
FORMS["memory"] = PLAIN | {
    "coulomb": Term(TORQUE, "z·(1 − exp(−|v|/vs))", "Coulomb friction"),
    "static": Term(TORQUE, "z·exp(−|v|/vs)", STATIC.meaning),
    "load": Term("1", "z·|τ|", "friction that grows with load: the gear's efficiency"),
    "speed": POWER,
    "memory": Term(TORQUE, "z10", "friction with a longer memory"),
    "memory_load": Term("1", "z10·|τ|", "the same, growing with load"),
    "dahl_length": LENGTH,
    "stribeck_velocity": STRIBECK_SPEED,
    "speed_exponent": EXPONENT,
}
"""Of `rigid-diffnea`, by its parameter `friction`."""

NETWORK: dict[str, Mapping[str, Term]] = {
    "coulomb": {"f_c": COULOMB, "f_v": VISCOUS, "offset": OFFSET},
    "stribeck": {
        "f_s": Term(TORQUE, "s·exp(−(max(|v|, v0)/vs)^δ)", STATIC.meaning),
        "f_c": Term(TORQUE, "s·(1 − exp(−(max(|v|, v0)/vs)^δ))", COULOMB.meaning),
        "f_v": Term(POWER.unit, "s·max(|v|, v0)^α", POWER.meaning),
        "v_s": STRIBECK_SPEED,
        "delta_s": STRIBECK_SHAPE,
        "alpha": EXPONENT,
        "offset": OFFSET,
    },
}
"""Of `lagrangian`, by its parameter `friction`, z for s with Dahl's state; others are networks."""

SHAPES = {
    "length": Term("rad", "x0", "shortest length of Dahl's state"),
    "stribeck": Term("rad/s", "vs", "speed at which the Stribeck peak has fallen to 1/e"),
    "power": Term("1", "p", "exponent of the concave speed law"),
    "turns": Term("1", "N", "motor turns per joint turn, as given; not fitted"),
}
"""Of `rigid-hysteresis`: `hil.estimators.friction_library.Shapes`."""

_HERE = f"{REFERENCE_C:g} °C"
_PEAK = "exp(−|v|/vs)"
_LIBRARY = {
    "offset": OFFSET,
    "viscous": VISCOUS,
    "coulomb": Term(TORQUE, "z", "Coulomb friction"),
    "load": Term("1", "z·|τ|", "friction that grows with load: the gear's efficiency"),
    "stribeck": Term(TORQUE, f"z·{_PEAK}", "Stribeck peak"),
    "stribeck narrow": Term(TORQUE, "z·exp(−|v|/(0.3·vs))", "narrow Stribeck peak"),
    "stribeck wide": Term(TORQUE, "z·exp(−|v|/(3·vs))", "wide Stribeck peak"),
    "stribeck load": Term("1", f"z·{_PEAK}·|τ|", "Stribeck peak that grows with load"),
    "stribeck wide load": Term("1", "z·exp(−|v|/(3·vs))·|τ|", "wide peak that grows with load"),
    "stribeck memory": Term(TORQUE, "z10·exp(−|v|/(0.3·vs))", "peak with a longer memory"),
    "braking": Term("1", "|z|·τ", "friction that differs as the load drives or brakes"),
    "drive": Term("1/(N·m)", "τ·|τ|", "current that grows faster than torque"),
    "speed p load": Term("(s/rad)^p", "sign(v)·|v|^p·|τ|", "speed law that grows with load"),
    "speed 1 load": Term("s/rad", "v·|τ|", "viscous friction that grows with load"),
    "speed 2 load": Term("(s/rad)²", "sign(v)·v²·|τ|", "friction with speed² and load"),
    "speed braking": Term("s/rad", "|v|·τ", "the same with speed, as the load drives or brakes"),
    "asymmetry": Term(DAMPING, "|v|", "other viscous friction one way"),
    "dry asymmetry": Term(TORQUE, "|z|", "other dry friction one way"),
    "temperature.1": Term("N·m/K", "z·(T − T0)", f"dry friction per kelvin over {_HERE}"),
    "temperature.2": Term(
        "N·m·(s/rad)^p/K", "sign(v)·|v|^p·(T − T0)", f"speed law per kelvin over {_HERE}"
    ),
}


def library_term(column: str) -> Term:
    """A column of `hil.estimators.friction_library`, by the name its coefficient has.

    Raises:
        KeyError: There is none of that name.
    """
    words, _, number = column.partition(".") if column[:4] in ("turn", "ripp") else (column, "", "")
    kind, *rest = words.split()
    if kind == "memory":
        return _memory(rest)
    if kind == "speed" and len(rest) == 1 and rest[0] != "braking":
        return Term(f"N·m·(s/rad)^{rest[0]}", f"sign(v)·|v|^{rest[0]}", "speed law")
    if kind == "turn":
        wave = f"{'sin' if number == '1' else 'cos'}({rest[0]}·q)"
        return Term(TORQUE, f"z·{wave}" if "dry" in rest else wave, "repeats with the joint's turn")
    if kind == "ripple":
        return _ripple(rest, number)
    return _LIBRARY[column]


def _memory(rest: list[str]) -> Term:
    if "load" in rest:
        return Term("1", f"z{rest[0]}·|τ|", f"load friction with {rest[0]} times the length")
    return Term(TORQUE, f"z{rest[0]}", f"dry friction with {rest[0]} times the length")


def _ripple(rest: list[str], number: str) -> Term:
    factors = [f"{'sin' if number == '1' else 'cos'}({rest[0]}·N·q)"]
    factors += ["exp(−|v|/vf)"] if "slow" in rest else []
    factors += ["tanh(v/0.01)"] if "sign" in rest else []
    return Term(TORQUE, "·".join(factors), f"ripple, {rest[0]} per motor turn")


def rest_term(name: str) -> Term:
    """A term of friction at rest (`hil.estimators.static_friction`) by name.

    Raises:
        KeyError: There is none of that name.
    """
    if name.startswith("ripple"):
        turns, wave = name.removeprefix("ripple").split("_")
        return Term(TORQUE, f"{wave}({turns}·N·q)", f"ripple, {turns} per motor turn")
    if name in _AT_REST:
        return _AT_REST[name]
    state, _, by = name.partition("_")
    if state != "coulomb" and not state.removeprefix("memory").isdigit():
        raise KeyError(name)
    z = "d" if state == "coulomb" else f"z{state.removeprefix('memory')}"
    if not by:
        return Term(TORQUE, z, "dry friction that the approach has left in the gear")
    unit, times, word = {
        "load": ("1", "|τ|", "with load"),
        "temperature": ("N·m/K", "(T − Tm)", "per kelvin"),
    }[by]
    return Term(unit, f"{z}·{times}", f"dry friction {word}")


_AT_REST = {
    "offset": OFFSET,
    "gain": Term("1", "τ", "error of the drive gain beside the other joints'"),
    "square": Term("1/(N·m)", "τ·|τ|", "current that does not grow linearly with torque"),
    "current_squared": Term("N·m/A²", "i·|i|", "−K2 of τ = K2·i·|i| + K1·i + K0 (paper protocol)"),
}

SQUARE = Term("N·m/A²", "i·|i|", "K2 of τ = K2·i·|i| + K1·i + K0; K1 is torque_per_effort")
"""Of `static-inverse`."""


def adapted(unit: str, *, slides: bool = False, torque: str = TORQUE) -> str:
    """The unit of a joint that slides, or of efforts whose drive gains nobody knows."""
    if slides:
        unit = unit.replace(TORQUE, "N").replace("rad", "m")
    return unit if torque == TORQUE else unit.replace(TORQUE, torque)
