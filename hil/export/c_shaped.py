"""Friction that a few numbers per joint shape, as C: straight-line code per joint."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.export.c_text import Piece, number
from hil.export.shaped import ShapedFriction

LONG = 10.0
"""The second state's length, as a multiple of the first's."""

POWER = """
/* base to a power, of a base above 0; larger than e to the 20 counts as that. */
static double hil_power(double base, double exponent)
{
    const double size = exponent * log(base);
    return exp(size < 20.0 ? size : 20.0);
}
"""

STATE = """\
    double z[{count}]; /* friction states */
    double last[HIL_N]; /* position of the sample before */
    int begun;
"""

RESET = """\
    for (i = 0; i < {count}; i++) {{ s->z[i] = 0.0; }}
    for (i = 0; i < HIL_N; i++) {{ s->last[i] = 0.0; }}
    s->begun = 0;
"""

END = """\
    for (i = 0; i < HIL_N; i++) { s->last[i] = q[i]; }
    s->begun = 1;
"""


def shaped_body(friction: ShapedFriction) -> str:
    """Statements of `hil_friction`, which writes `friction[j]` of every joint."""
    lines = ["(void)s; (void)q; (void)torque; (void)ripple; (void)drive;"]
    if friction.length is not None:
        lines.insert(0, "int i;")
    for j in range(len(friction.coulomb)):
        lines += ["{", *(f"    {line}" for line in _joint(friction, j)), "}"]
    body = "".join(f"    {line}\n" for line in lines)
    return body + (END if friction.length is not None else "")


def shaped_memory(friction: ShapedFriction) -> Piece:
    """The states it carries, if any, and the function that its shapes need."""
    peaked = (friction.static != friction.coulomb) & (friction.stribeck_exponent != 1.0)
    power = POWER * bool(np.any(peaked) or np.any(friction.power))
    if friction.length is None:
        return Piece(functions=power)
    count = len(_multiples(friction)) * len(friction.coulomb)
    state, reset = STATE.format(count=count), RESET.format(count=count)
    return Piece(state=state, functions=power, reset=reset)


def _multiples(friction: ShapedFriction) -> tuple[float, ...]:
    far = bool(friction.far.any() or friction.far_load.any())
    return (1.0, LONG) if far else (1.0,)


def _joint(law: ShapedFriction, j: int) -> Iterator[str]:
    remembers = law.length is not None
    sign = _sign(law.sign_width)
    yield f"const double v = qd[{j}];"
    yield f"const double speed = {_speed(law)};"
    if remembers:
        yield from _states(law, j)
    if not remembers or (law.power[j] and not law.power_remembers):
        yield f"const double sense = {sign};"
    toward = "z0" if remembers else "sense"
    peak = law.static[j] - law.coulomb[j]
    size = [number(float(law.coulomb[j]))]
    if peak:
        size.append(f"{number(float(peak))} * {_peak(law, j)}")
    if law.load[j]:
        size.append(f"{number(float(law.load[j]))} * fabs(torque[{j}])")
    terms = [f"{toward} * ({' + '.join(size)})"]
    if law.power[j]:
        way = toward if law.power_remembers else "sense"
        power = f"hil_power(speed, {number(float(law.exponent[j]))})"
        terms.append(f"{number(float(law.power[j]))} * {way} * {power}")
    terms.append(f"{number(float(law.viscous[j]))} * v + {number(float(law.offset[j]))}")
    if len(_multiples(law)) > 1 and remembers:
        far = f"{number(float(law.far[j]))} + {number(float(law.far_load[j]))} * fabs(torque[{j}])"
        terms.append(f"z1 * ({far})")
    yield "(void)speed;"
    yield f"friction[{j}] = " + "\n        + ".join(terms) + ";"


def _peak(law: ShapedFriction, j: int) -> str:
    slowed = number(float(law.stribeck_speed[j]))
    if law.stribeck_exponent[j] == 1.0:
        return f"exp(-fabs(v) / {slowed})"
    return f"exp(-hil_power(speed / {slowed}, {number(float(law.stribeck_exponent[j]))}))"


def _sign(width: float) -> str:
    return f"tanh(v / {number(width)})" if width > 0 else "(double)((v > 0.0) - (v < 0.0))"


def _speed(law: ShapedFriction) -> str:
    if law.more_speed:
        return f"fabs(v) + {number(law.more_speed)}"
    least = number(law.least_speed)
    return f"fabs(v) > {least} ? fabs(v) : {least}"


def _states(law: ShapedFriction, j: int) -> Iterator[str]:
    """Dahl's states one step on: only what goes with the velocity counts as way."""
    assert law.length is not None
    yield f"double way = s->begun ? q[{j}] - s->last[{j}] : 0.0;"
    yield "const double toward = way * v > 0.0 ? (way > 0.0 ? 1.0 : -1.0) : 0.0;"
    yield "way = toward == 0.0 ? 0.0 : fabs(way);"
    multiples = _multiples(law)
    for k, multiple in enumerate(multiples):
        place = f"s->z[{j * len(multiples) + k}]"
        length = number(-1.0 / (multiple * float(law.length[j])))
        yield f"const double z{k} = toward + ({place} - toward) * exp(way * {length});"
        yield f"{place} = z{k};"
