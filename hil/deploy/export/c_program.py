"""A fitted model as a C99 file with its header: constants, one structure of state, one step.

Nothing is allocated, nothing is global but constants, and there is no input that makes it divide by
zero, take a logarithm of 0 or leave its arrays: it may run in a PREEMPT_RT task, in a TwinCAT C++
module or on a microcontroller with a double-precision library.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from hil.deploy.export.c_friction import friction_piece
from hil.deploy.export.c_lagrangian import lagrangian_piece
from hil.deploy.export.c_rigid import bodies_of_gears, rigid_piece
from hil.deploy.export.c_text import Piece, array, comment
from hil.deploy.export.program import Program
from hil.errors import SpecError

PARTS = ("gravity", "inertia", "load", "friction", "ripple", "drive", "residual")
"""Of the effort, in this order in `hil_parts`; they add up to it."""

PREFIX = re.compile(r"[a-z][a-z0-9_]{0,30}\Z")


@dataclass(frozen=True, slots=True)
class CSource:
    """Text of both files.

    Attributes:
        prefix: What all symbols begin with.
        header: `PREFIX.h`.
        source: `PREFIX.c`.
    """

    prefix: str
    header: str
    source: str


def c_source(program: Program, prefix: str = "hil", told: str = "") -> CSource:
    """Header and source.

    Args:
        program: What to compute.
        prefix: What all symbols begin with; also the name of the files.
        told: For the head of both files: which model this is.

    Raises:
        SpecError: The prefix cannot be one.
    """
    if not PREFIX.match(prefix):
        raise SpecError(
            f"the prefix {prefix!r} cannot begin the names of C functions",
            hint="use small letters, digits and _, a letter first, at most 31 of them",
        )
    network = Piece()
    if program.correction is not None:
        from hil.deploy.export.c_network import network_piece

        network = network_piece(program.correction, program.n)
    pieces = (rigid_piece(program), lagrangian_piece(program), friction_piece(program), network)
    head = f"/* {comment(told or program.estimator)}. Written by hil; do not edit. */\n"
    header = head + _header(program, pieces)
    source = head + _source(program, pieces, network != Piece())
    source = _renamed(source, prefix).replace("@HEADER@", f"{prefix}.h")
    return CSource(prefix, _renamed(header, prefix), source)


def _renamed(text: str, prefix: str) -> str:
    if prefix == "hil":
        return text
    text = re.sub(r"\bhil_", f"{prefix}_", text)
    return re.sub(r"\bHIL_", f"{prefix.upper()}_", text)


def _header(program: Program, pieces: tuple[Piece, ...]) -> str:
    state = "".join(piece.state for piece in pieces)
    parts = "".join(f"    double {name}[HIL_N];\n" for name in PARTS)
    unit = "A" if program.effort_kind == "current" else "N*m"
    return HEADER.format(
        n=program.n,
        state=state,
        parts=parts,
        unit=unit,
        joints=comment(", ".join(program.joint_names)),
    )


def _source(program: Program, pieces: tuple[Piece, ...], corrected: bool) -> str:
    constants = "".join(piece.constants for piece in pieces)
    functions = "".join(piece.functions for piece in pieces)
    reset = "".join(piece.reset for piece in pieces)
    gears = bodies_of_gears(program)
    transmitted = "rigid"
    second = ""
    if gears != "hil_bodies":
        transmitted = "gears"
        second = f"    hil_collect(&m, {gears}, s->load, qdd, gears);\n"
    step = STEP.replace("@SECOND@", second).replace("@TRANSMITTED@", transmitted)
    step = step.replace("@DECLARED@", ", gears[HIL_N]" if second else "")
    step = step.replace("@NETWORK@", NETWORK if corrected else "")
    learned = program.lagrangian is not None
    for word, code in LEARNED.items():
        step = step.replace(word, code if learned else "")
    scale = array("hil_scale", 1.0 / program.scale)
    start = '#include "@HEADER@"\n\n#include <math.h>\n#include <stddef.h>\n'
    start += "#include <stdint.h>\n\n" if learned else "\n"
    begin = f"\nvoid hil_reset(hil_state *s)\n{{\n    int i;\n{reset}}}\n"
    return start + constants + scale + functions + begin + step


HEADER = """#ifndef HIL_MODEL_H
#define HIL_MODEL_H

/* Joints: {joints}. Angles in rad, efforts in {unit}. */
#define HIL_N {n}

#ifdef __cplusplus
extern "C" {{
#endif

typedef struct {{
{state}}} hil_state;

/* Parts of an effort; they add up to it. */
typedef struct {{
{parts}}} hil_parts;

/* Before the first sample, and whenever samples stop coming. The load is taken off. */
void hil_reset(hil_state *s);

/* What is mounted: mass [kg], centre of mass [m] in the flange's frame, inertia about it
   (xx, yy, zz, xy, xz, yz) [kg*m2]. Returns 0, or -1 for what is no load, and changes nothing. */
int hil_set_load(hil_state *s, double mass, const double com[3], const double inertia[6]);

/* One sample in, one effort per joint out. `parts` may be NULL. Returns 0, or -1 if an input is
   not finite or beyond 1e6; then nothing is written and nothing remembered. */
int hil_step(hil_state *s, const double q[HIL_N], const double qd[HIL_N], const double qdd[HIL_N],
             double effort[HIL_N], hil_parts *parts);

#ifdef __cplusplus
}}
#endif

#endif
"""

NETWORK = """    hil_network(s, q, qd, qdd, effort, residual);
    for (i = 0; i < HIL_N; i++) { effort[i] += residual[i]; }
"""

LEARNED = {
    "@LEARNED@": "    hil_lagrangian(q, qd, qdd, rigid);\n",
    "@LEARNED_BARE@": "    hil_lagrangian(q, qd, qdd, bare);\n",
    "@LEARNED_GRAVITY@": "    hil_lagrangian(q, still, still, parts->gravity);\n",
}
"""What a Lagrangian network adds to bodies that are nothing but the load."""

STEP = r"""
/* Within 1e6, by the bits: to compare what is no number is an invalid operation, and traps. */
static int hil_finite(const double *v, int count)
{
    union { double number; unsigned long long bits; } size, most;
    int i;
    most.number = 1e6;
    for (i = 0; i < count; i++) {
        size.number = v[i];
        size.bits &= 0x7fffffffffffffffULL;
        if (size.bits > most.bits) { return 0; }
    }
    return 1;
}

int hil_set_load(hil_state *s, double mass, const double com[3], const double inertia[6])
{
    if (!hil_finite(&mass, 1) || mass < 0.0 || !hil_finite(com, 3) || !hil_finite(inertia, 6)) {
        return -1;
    }
    hil_mount(s, mass, com, inertia);
    return 0;
}

static void hil_explain(hil_motion *m, const double *q, const double *qd, const double *qdd,
                        const double *rigid, hil_parts *parts)
{
    static const double still[HIL_N] = {0.0};
    double bare[HIL_N];
    int i;
    (void)qd;
    hil_collect(m, hil_bodies, NULL, qdd, bare);
@LEARNED_BARE@    hil_move(q, still, still, m);
    hil_collect(m, hil_bodies, NULL, still, parts->gravity);
@LEARNED_GRAVITY@    for (i = 0; i < HIL_N; i++) {
        parts->load[i] = (rigid[i] - bare[i]) * hil_scale[i];
        parts->inertia[i] = (bare[i] - parts->gravity[i]) * hil_scale[i];
        parts->gravity[i] *= hil_scale[i];
    }
}

int hil_step(hil_state *s, const double q[HIL_N], const double qd[HIL_N], const double qdd[HIL_N],
             double effort[HIL_N], hil_parts *parts)
{
    hil_motion m;
    double rigid[HIL_N], friction[HIL_N], ripple[HIL_N], drive[HIL_N], residual[HIL_N]@DECLARED@;
    int i;
    if (!hil_finite(q, HIL_N) || !hil_finite(qd, HIL_N) || !hil_finite(qdd, HIL_N)) { return -1; }
    for (i = 0; i < HIL_N; i++) { friction[i] = ripple[i] = drive[i] = residual[i] = 0.0; }
    hil_move(q, qd, qdd, &m);
    hil_collect(&m, hil_bodies, s->load, qdd, rigid);
@LEARNED@@SECOND@    hil_friction(s, q, qd, @TRANSMITTED@, friction, ripple, drive);
    for (i = 0; i < HIL_N; i++) {
        effort[i] = (rigid[i] + friction[i] + ripple[i] + drive[i]) * hil_scale[i];
    }
@NETWORK@    if (parts) {
        hil_explain(&m, q, qd, qdd, rigid, parts);
        for (i = 0; i < HIL_N; i++) {
            parts->friction[i] = friction[i] * hil_scale[i];
            parts->ripple[i] = ripple[i] * hil_scale[i];
            parts->drive[i] = drive[i] * hil_scale[i];
            parts->residual[i] = residual[i];
        }
    }
    return 0;
}
"""
