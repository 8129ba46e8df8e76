"""Friction as C: straight-line code per joint, with nothing computed that no term asks for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from hil.export.c_memory import memory_body, memory_state
from hil.export.c_network_friction import network_friction_piece
from hil.export.c_shaped import shaped_body, shaped_memory
from hil.export.c_text import Piece, number
from hil.export.lagrangian_terms import NetworkFriction
from hil.export.program import PlainFriction, Program
from hil.export.shaped import ShapedFriction

UNUSED = "    (void)s; (void)q; (void)torque; (void)ripple; (void)drive;"

LEARNED = """\
    (void)s; (void)torque; (void)ripple; (void)drive;
    hil_friction_network(q, qd, friction);"""

SIGN = """
static double hil_sign(double v) { return (double)((v > 0.0) - (v < 0.0)); }
"""


def friction_piece(program: Program) -> Piece:
    """`hil_friction(s, q, qd, tau, friction, ripple, drive)` in N·m, and the states it carries."""
    friction = program.friction
    if isinstance(friction, PlainFriction):
        lines = [line for j in range(program.n) for line in _plain(friction, j)]
        return Piece(functions=SIGN * (friction.sign_width == 0) + _function([UNUSED, *lines]))
    if isinstance(friction, ShapedFriction):
        memory = shaped_memory(friction)
        function = _function([shaped_body(friction)])
        return replace(memory, functions=memory.functions + function)
    if isinstance(friction, NetworkFriction):
        network = network_friction_piece(friction)
        function = _function([LEARNED])
        return replace(network, functions=network.functions + function)
    function, memory = memory_body(friction), memory_state(friction)
    return replace(memory, functions=_function([function]))


def _plain(friction: PlainFriction, j: int) -> Iterator[str]:
    width = friction.sign_width
    sign = f"tanh(qd[{j}] / {number(width)})" if width > 0 else f"hil_sign(qd[{j}])"
    power = f"qd[{j}]"
    if friction.exponent[j] != 1.0:
        half = number(0.5 * (friction.exponent[j] - 1.0))
        square = number(friction.power_width**2)
        power += f" * exp({half} * log(qd[{j}] * qd[{j}] + {square}))"
    terms = (friction.coulomb[j], friction.viscous[j], friction.offset[j])
    c, v, o = (number(float(term)) for term in terms)
    yield f"    friction[{j}] = {c} * {sign} + {v} * {power} + {o};"


def _function(lines: Sequence[str]) -> str:
    body = "\n".join(lines)
    return f"""
static void hil_friction(hil_state *s, const double *q, const double *qd, const double *torque,
                         double *friction, double *ripple, double *drive)
{{
{body}
}}
"""
