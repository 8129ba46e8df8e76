"""Friction terms of a JSON document: unit, column and meaning of each term, and the friction law.

The `column` of a parameter is the expression by which it is multiplied to give a torque. The module
`hil.export.json_reader` evaluates the columns of friction from the formulas in the document. In the
formulas, v is the velocity of the joint, s the smooth sign of v, z Dahl's state in place of s, z10
Dahl's state with ten times the length, τ the torque through the gear, and T the joint temperature.
The function `friction_part` describes the law that sums the columns: its name, formula and
constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from hil.estimators import (
    LEAST_SPEED,
    NARROWEST,
    REFERENCE_C,
    RIPPLE_FADES_RAD_S,
    RigidDiffnea,
    RigidHysteresis,
    RigidIrls,
    RigidLinear,
    RobotEstimator,
    StaticFriction,
    StaticHysteresis,
    StaticInverse,
    StaticModel,
)
from hil.export.program import LEAST_NETWORK_SPEED
from hil.networks import LagrangianEstimator, ResidualNetwork, StaticMlpLm


class Term(NamedTuple):
    """Friction term: description of a joint parameter.

    Attributes:
        unit: Unit of the parameter for a revolute joint with torques in N·m; see `adapted` for
            other joints.
        column: Expression by which the parameter is multiplied to give a torque, or its symbol.
        meaning: Meaning of the parameter as text.
    """

    unit: str
    column: str
    meaning: str


TORQUE, DAMPING = "N·m", "N·m·s/rad"


def adapted(unit: str, *, slides: bool = False, torque: str = TORQUE) -> str:
    """Return the unit for a prismatic joint, or for efforts without known drive gains."""
    if slides:
        unit = unit.replace(TORQUE, "N").replace("rad", "m")
    return unit if torque == TORQUE else unit.replace(TORQUE, torque)


COULOMB = Term(TORQUE, "s", "Coulomb friction")
VISCOUS = Term(DAMPING, "v", "viscous friction")
OFFSET = Term(
    TORQUE, "1", "constant: bias of drive or sensor, or friction that depends on the direction"
)
STATIC = Term(TORQUE, "s", "static friction, at very low speed")
POWER = Term("N·m·(s/rad)^α", "s·(|v| + v0)^α", "friction that grows with a power of speed")
EXPONENT = Term("1", "α", "exponent α of the speed")
STRIBECK_SPEED = Term(
    "rad/s", "vs", "Stribeck speed: scale of the transition from static to Coulomb friction"
)
STRIBECK_SHAPE = Term("1", "δ", "exponent of the Stribeck transition")
LENGTH = Term("rad", "x0", "displacement constant of Dahl's state after a reversal")

PLAIN = {"coulomb": COULOMB, "viscous": VISCOUS, "offset": OFFSET}
"""Friction terms of `rigid-wls` and similar estimators."""

POWER_VISCOUS = Term(
    "N·m·(s/rad)^α", "v·(v² + w²)^((α − 1)/2)", "friction that grows with a power of speed"
)
"""Viscous friction term of `rigid-irls`."""

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
    "memory_load": Term("1", "z10·|τ|", "friction with a longer memory that grows with load"),
    "dahl_length": LENGTH,
    "stribeck_velocity": STRIBECK_SPEED,
    "speed_exponent": EXPONENT,
}
"""Friction terms of `rigid-diffnea`, by the value of its parameter `friction`."""

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
"""Friction terms of `lagrangian`, by the value of its parameter `friction`.

With Dahl's state, z replaces s in the columns. Friction kinds without an entry are networks, whose
weights are not friction terms.
"""

SHAPES = {
    "length": Term("rad", "x0", "shortest length of Dahl's state"),
    "stribeck": Term("rad/s", "vs", "speed at which the Stribeck peak has fallen to 1/e"),
    "power": Term("1", "p", "exponent of the concave speed law"),
    "turns": Term("1", "N", "motor turns per joint turn, as set; not fitted"),
}
"""Shape parameters of `rigid-hysteresis`: `hil.estimators.friction_library.Shapes`."""

_PEAK = "exp(−|v|/vs)"
_HERE = f"{REFERENCE_C:g} °C"

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
    "braking": Term("1", "|z|·τ", "difference of friction between driving and braking loads"),
    "drive": Term("1/(N·m)", "τ·|τ|", "current that grows faster than torque"),
    "speed p load": Term("(s/rad)^p", "sign(v)·|v|^p·|τ|", "speed law that grows with load"),
    "speed 1 load": Term("s/rad", "v·|τ|", "viscous friction that grows with load"),
    "speed 2 load": Term("(s/rad)²", "sign(v)·v²·|τ|", "friction that grows with speed² and load"),
    "speed braking": Term(
        "s/rad", "|v|·τ", "difference of friction between driving and braking loads, times speed"
    ),
    "asymmetry": Term(DAMPING, "|v|", "difference of viscous friction between the directions"),
    "dry asymmetry": Term(TORQUE, "|z|", "difference of dry friction between the directions"),
    "temperature.1": Term("N·m/K", "z·(T − T0)", f"dry friction per kelvin above {_HERE}"),
    "temperature.2": Term(
        "N·m·(s/rad)^p/K", "sign(v)·|v|^p·(T − T0)", f"speed law per kelvin above {_HERE}"
    ),
}


def library_term(column: str) -> Term:
    """Return the term of a column of `hil.estimators.friction_library`, by its coefficient name.

    Raises:
        KeyError: The coefficient name is unknown.
    """
    words, _, number = column.partition(".") if column[:4] in ("turn", "ripp") else (column, "", "")
    kind, *rest = words.split()
    if kind == "memory":
        return _memory(rest)
    if kind == "speed" and len(rest) == 1 and rest[0] != "braking":
        return Term(f"N·m·(s/rad)^{rest[0]}", f"sign(v)·|v|^{rest[0]}", "speed law")
    if kind == "turn":
        wave = f"{'sin' if number == '1' else 'cos'}({rest[0]}·q)"
        return Term(TORQUE, f"z·{wave}" if "dry" in rest else wave, "periodic in the joint angle")
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


_REST_TERMS = {
    "offset": OFFSET,
    "gain": Term("1", "τ", "error of the drive gain relative to the other joints"),
    "square": Term("1/(N·m)", "τ·|τ|", "current that does not grow linearly with torque"),
    "current_squared": Term("N·m/A²", "i·|i|", "−K2 of τ = K2·i·|i| + K1·i + K0 (paper protocol)"),
}


def rest_term(name: str) -> Term:
    """Return a term of friction at standstill (`hil.estimators.static_friction`) by its name.

    Raises:
        KeyError: The name of the term is unknown.
    """
    if name.startswith("ripple"):
        turns, wave = name.removeprefix("ripple").split("_")
        return Term(TORQUE, f"{wave}({turns}·N·q)", f"ripple, {turns} per motor turn")
    if name in _REST_TERMS:
        return _REST_TERMS[name]
    state, _, by = name.partition("_")
    if state != "coulomb" and not state.removeprefix("memory").isdigit():
        raise KeyError(name)
    z = "d" if state == "coulomb" else f"z{state.removeprefix('memory')}"
    if not by:
        return Term(TORQUE, z, "dry friction that remains in the gear after the approach")
    unit, times, word = {
        "load": ("1", "|τ|", "with load"),
        "temperature": ("N·m/K", "(T − Tm)", "per kelvin"),
    }[by]
    return Term(unit, f"{z}·{times}", f"dry friction {word}")


SQUARE = Term("N·m/A²", "i·|i|", "K2 of τ = K2·i·|i| + K1·i + K0; K1 is torque_per_effort")
"""Quadratic drive term of the estimator `static-inverse`."""

DAHL = (
    "z: initially 0; from sample to sample z ← σ + (z − σ)·exp(−|Δq|/x0) if Δq·v > 0, with σ the "
    "sign of Δq; otherwise, also for v = 0, z is unchanged; z3, z10, …: with 3, 10, … times x0"
)

SYMBOLS = "vf = ripple_fades_rad_s; T0 = reference_celsius; T = usual_celsius (T0 if null)"
V0 = "v0 = least_speed_rad_s"
SUM = "sum of value × column over the parameters of the joint"
SMOOTH = "s = tanh(v/sign_width_rad_s), or the sign of v if the width is 0"


def friction_part(model: RobotEstimator) -> dict[str, Any]:
    """Return the friction law of the parameters: its name, its formula and its constants."""
    if isinstance(model, ResidualNetwork):
        return friction_part(model.base_)
    if isinstance(model, RigidHysteresis):
        constants = {"reference_celsius": REFERENCE_C, "ripple_fades_rad_s": RIPPLE_FADES_RAD_S}
        usual = {"usual_celsius": model.law_.celsius}
        return _law_document("library", f"{SUM}; {DAHL}; {SYMBOLS}", True, constants | usual)
    if isinstance(model, LagrangianEstimator):
        return _network_law(model)
    if isinstance(model, RigidDiffnea):
        memory, width = model.friction == "memory", {"sign_width_rad_s": model.sign_width}
        words = f"{SUM}; {SMOOTH}; {V0}" + f"; {DAHL}" * memory
        return _law_document(
            model.friction, words, memory, width | {"least_speed_rad_s": LEAST_SPEED}
        )
    if isinstance(model, RigidLinear):
        constants = {"sign_width_rad_s": model.sign_width}
        if not isinstance(model, RigidIrls):
            return _law_document("coulomb-viscous", f"{SUM}; {SMOOTH}", False, constants)
        constants["power_width_rad_s"] = model.sign_width or NARROWEST
        words = f"{SUM}; {SMOOTH}; w = power_width_rad_s"
        return _law_document("coulomb-viscous", words, False, constants)
    if isinstance(model, StaticFriction):
        return _law_at_rest(model)
    noise = "friction at standstill is treated as noise"
    if isinstance(model, StaticInverse):
        solved = "gravity = K2·i·|i| + K1·i + K0, solved for the current i; offset is −K0"
        return _law_document("none", f"{solved}; {noise}", False, {})
    if isinstance(model, StaticMlpLm):
        return _law_document(
            "network", f"{SUM}; friction at standstill is the output of the networks", False, {}
        )
    if isinstance(model, StaticModel):
        return _law_document("none", f"{SUM}; {noise}", False, {})
    return _law_document(
        "unknown", "of an estimator that is unknown to this version of hil", False, {}
    )


def _network_law(model: LagrangianEstimator) -> dict[str, Any]:
    kind, hard = model.design_.kind, model.design_.friction.sign == "hard"
    if kind not in NETWORK:
        return _law_document(kind, f"{kind}: a network without interpretable parameters", False, {})
    constants = {} if remembers(model) else {"sign_width_rad_s": 0.0 if hard else model.sign_width}
    sign = DAHL if remembers(model) else SMOOTH
    if kind == "stribeck":
        constants["least_speed_rad_s"] = LEAST_NETWORK_SPEED
        sign = f"{sign}; {V0}"
    return _law_document(kind, f"{SUM}; {sign}", remembers(model), constants)


def _law_document(
    name: str, formula: str, memory: bool, constants: dict[str, Any], **more: Any
) -> dict[str, Any]:
    base = {"law": name, "formula": formula, "memory": memory, "constants": constants}
    return base | {"level_nm": more.get("level_nm")}


REST_SYMBOLS = (
    "d: +1 if the pose was approached from below, −1 from above; z1, z2, …: Dahl's states with "
    "lengths_rad along the smoothed path into the pose; τ: torque of the group gear and of the "
    "load, limited to load_limit_nm; N = gear_ratio; Tm = mean_celsius"
)


def _law_at_rest(model: StaticFriction) -> dict[str, Any]:
    constants: dict[str, Any] = {
        "load_limit_nm": model.load_limit_,
        "mean_celsius": model.celsius_,
    }
    if isinstance(model, StaticHysteresis):
        constants["lengths_rad"] = model.lengths_rad
        constants["gear_ratio"] = model.gear_ratio
    return _law_document(
        "rest", f"{SUM}; {REST_SYMBOLS}", True, constants, level_nm=model.dry_friction()
    )


def remembers(model: LagrangianEstimator) -> bool:
    """Return whether the friction uses Dahl's state in place of the sign of the velocity."""
    return model.length_ is not None and model.design_.friction.sign != "hard"
