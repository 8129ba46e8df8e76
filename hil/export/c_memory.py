"""Friction of the library as C: states that remember, shapes and waves, joint by joint."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hil.core import FloatArray
from hil.estimators import MULTIPLES, ORDERS, PARTS, REFERENCE_C, RIPPLE_FADES_RAD_S, FrictionLaw
from hil.export.c_columns import GROUPS, LAWS, PEAKS, SUMS
from hil.export.c_text import Piece, number
from hil.export.program import terms_of

SLOWEST = 1e-12
"""Below this speed [rad/s] a power of it is 0: no logarithm of 0."""

UNUSED = "    (void)friction; (void)ripple; (void)drive; (void)torque; (void)qd;"

WARMTH = "    double warmer_k[HIL_N]; /* joints, than in the training [K] */\n"


def memory_body(law: FrictionLaw) -> str:
    """Statements of `hil_friction`."""
    joints = terms_of(law)
    lines = [line for j, terms in enumerate(joints) for line in _joint(law, j, terms)]
    end = "    for (i = 0; i < HIL_N; i++) { s->last[i] = q[i]; }\n    s->begun = 1;"
    return "\n".join(["    int i;", UNUSED, *_numbered(lines), end])


def memory_state(law: FrictionLaw) -> Piece:
    """What it carries from sample to sample."""
    joints = terms_of(law)
    count = max(sum(len(_states(terms)) for terms in joints), 1)
    state = (
        f"    double z[{count}]; /* friction states */\n"
        "    double last[HIL_N]; /* position of the sample before */\n"
        "    int begun;\n"
    )
    reset = f"    for (i = 0; i < {count}; i++) {{ s->z[i] = 0.0; }}\n    s->begun = 0;\n"
    reset += "    for (i = 0; i < HIL_N; i++) { s->last[i] = 0.0; }\n"
    if knows_warmth(law):
        state += WARMTH
        reset += "    for (i = 0; i < HIL_N; i++) { s->warmer_k[i] = 0.0; }\n"
    return Piece(state=state, reset=reset)


def knows_warmth(law: object) -> bool:
    """Whether friction depends on how warm joints are."""
    return isinstance(law, FrictionLaw) and any("temperature" in terms for terms in terms_of(law))


def _numbered(lines: Sequence[str]) -> list[str]:
    """States get their places in the order in which they are advanced."""
    places: dict[str, int] = {}

    def place(found: re.Match[str]) -> str:
        return f"s->z[{places.setdefault(found[0], len(places))}]"

    return [re.sub(r"STATE_\d+_\d+", place, line) for line in lines]


def _states(terms: Mapping[str, FloatArray]) -> list[float]:
    """Multiples whose states a joint's terms ask for."""
    used = _used(terms)
    return [k for k in MULTIPLES if f"z{k:g}" in used]


def _used(terms: Mapping[str, FloatArray]) -> set[str]:
    words = re.findall(r"[a-z_]+\d*", " ".join(_expression(terms)))
    return set(words)


def _expression(terms: Mapping[str, FloatArray], part: str | None = None) -> list[str]:
    """Coefficient times column, of one part of the effort or of all."""
    found = []
    for name, weights in terms.items():
        if part is not None and PARTS.get(name.split()[0], "friction") != part:
            continue
        for column, weight in zip(GROUPS[name], weights, strict=True):
            if weight:
                found.append(f"{number(float(weight))} * {column}")
    return found


def _joint(law: FrictionLaw, j: int, terms: Mapping[str, FloatArray]) -> Iterator[str]:
    used = _used(terms)
    yield "    {"
    for line in (
        *_basics(law, j, used), *_memory(law, j, terms),
        *_shapes(law, j, used), *_waves(law, j, used),
    ):  # fmt: skip
        yield f"        {line}"
    for part in ("friction", "ripple", "drive"):
        summed = _expression(terms, part)
        if summed:
            yield f"        {part}[{j}] = " + "\n            + ".join(summed) + ";"
    yield "    }"


def _basics(law: FrictionLaw, j: int, used: set[str]) -> Iterator[str]:
    yield f"const double v = qd[{j}], speed = fabs(v);"
    if used & {"tau", "load"}:
        yield f"const double tau = torque[{j}];"
        yield "(void)tau;"
    if "load" in used:
        yield "const double load = fabs(tau);"
    if "slow" in used:
        yield f"const double slow = exp(-speed / {number(RIPPLE_FADES_RAD_S)});"
    if "sense" in used:
        yield "const double sense = tanh(v / 0.01);"
    if "warmth" in used:
        usual = REFERENCE_C if law.celsius is None else float(law.celsius[j])
        warm = number(float(np.nan_to_num(usual - REFERENCE_C)))
        yield f"const double warmth = s->warmer_k[{j}] + {warm};"
    yield "(void)v; (void)speed;"


def _memory(law: FrictionLaw, j: int, terms: Mapping[str, FloatArray]) -> Iterator[str]:
    """Dahl's states one step on: only what goes with the velocity counts as way."""
    multiples = _states(terms)
    if not multiples:
        return
    yield f"double way = s->begun ? q[{j}] - s->last[{j}] : 0.0;"
    yield "const double toward = way * v > 0.0 ? (way > 0.0 ? 1.0 : -1.0) : 0.0;"
    yield "way = toward == 0.0 ? 0.0 : fabs(way);"
    for k in multiples:
        place, length = f"STATE_{j}_{int(k)}", number(-1.0 / (k * float(law.shapes.length[j])))
        yield f"const double z{k:g} = toward + ({place} - toward) * exp(way * {length});"
        yield f"{place} = z{k:g};"


def _shapes(law: FrictionLaw, j: int, used: set[str]) -> Iterator[str]:
    for name, width in PEAKS.items():
        if name in used:
            yield f"const double {name} = exp(speed * {_inverse(-width * law.shapes.stribeck[j])});"
    wanted = {"law_p": float(law.shapes.power[j]), **LAWS}
    powers = {name: power for name, power in wanted.items() if name in used}
    if powers:
        yield f"const double slog = log(speed > {number(SLOWEST)} ? speed : {number(SLOWEST)});"
        yield f"const double toward_v = speed > {number(SLOWEST)} ? (v > 0.0 ? 1.0 : -1.0) : 0.0;"
    for name, power in powers.items():
        yield f"const double {name} = toward_v * exp({number(power)} * slog);"


def _waves(law: FrictionLaw, j: int, used: set[str]) -> Iterator[str]:
    turns = float(np.nan_to_num(law.shapes.turns[j]))
    for first, angle in (("", f"{number(turns)} * q[{j}]"), ("j", f"q[{j}]")):
        orders = {k for k in (*ORDERS, 1) if {f"{first}sin{k}", f"{first}cos{k}"} & used}
        if not orders:
            continue
        yield f"const double {first}angle = {angle};"
        yield f"const double {first}sin1 = sin({first}angle), {first}cos1 = cos({first}angle);"
        yield f"(void){first}sin1; (void){first}cos1;"
        for k in sorted(_needed(orders) - {1}):
            a, b = SUMS[k]
            s, c = f"{first}sin", f"{first}cos"
            yield (
                f"const double {s}{k} = {s}{a} * {c}{b} + {c}{a} * {s}{b}, "
                f"{c}{k} = {c}{a} * {c}{b} - {s}{a} * {s}{b};"
            )
            yield f"(void){s}{k}; (void){c}{k};"


def _needed(orders: set[int]) -> set[int]:
    found = set(orders)
    for k in sorted(orders, reverse=True):
        found |= _needed(set(SUMS[k])) if k in SUMS else set()
    return found


def _inverse(value: float) -> str:
    return number(1.0 / float(value))
