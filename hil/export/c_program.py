"""A fitted model as a C99 file with its header: constants, one structure of state, one step.

Nothing is allocated, nothing is global but constants, and there is no input that makes it divide by
zero, take a logarithm of 0 or leave its arrays: it may run in a PREEMPT_RT task, in a TwinCAT C++
module or on a microcontroller with a double-precision library.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from hil.core import SpecError
from hil.export.c_friction import friction_piece
from hil.export.c_lagrangian import lagrangian_piece
from hil.export.c_memory import knows_warmth
from hil.export.c_network import network_piece
from hil.export.c_program_text import (
    HEADER,
    LEARNED,
    NETWORK,
    RESTRICT,
    SET_WARMTH,
    STEP,
    TAKE_WARMTH,
)
from hil.export.c_rigid import bodies_of_gears, rigid_piece
from hil.export.c_text import Piece, array, comment
from hil.export.program import Program

PARTS = ("gravity", "inertia", "load", "friction", "ripple", "drive", "residual")
"""Of the effort, in this order in `hil_parts`; they add up to it."""

PREFIX = re.compile(r"[a-z][a-z0-9_]{0,30}\Z")

HEADERS = """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign
    stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time
    uchar wchar wctype features endian alloca malloc memory unistd values
"""
TARGETS = """
    all clean depend edit_cache help install list_install_components package package_source
    preinstall rebuild_cache test
"""
WORDS = """
    auto break case char const continue default do double else enum extern for goto if inline int
    long register return short signed sizeof static struct switch typedef union unsigned void
    volatile while restrict
"""
TAKEN = frozenset((HEADERS + TARGETS + WORDS).split())
"""Headers of C, targets of CMake, words of C: no names for a file, a target and symbols."""


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
    if prefix in TAKEN:
        raise SpecError(
            f"the prefix {prefix!r} is a name that C or CMake has for something else",
            hint="take another, such as arm",
        )
    network = Piece()
    if program.correction is not None:
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
    return HEADER.format(
        n=program.n,
        state=state,
        parts=parts,
        units=_units(program),
        joints=comment(", ".join(program.joint_names)),
        warmth=SET_WARMTH if knows_warmth(program.friction) else "",
    )


def _units(program: Program) -> str:
    """Of positions and efforts, joint by joint where some slide."""
    torques = program.effort_kind != "current"
    turns = [bool(one) for one in program.geometry.turns]
    if program.coupling is not None:
        # A motor's place is told in the unit of what it moves.
        whose, start = "motors behind their gears", "All arrays are of "
    else:
        whose, start = "joints", ""
    if all(turns):
        what = f"Angles in rad, efforts in {'N*m' if torques else 'A'}."
    else:
        each = ", ".join("m" if not one else "rad" for one in turns)
        efforts = ", ".join("N*m" if one else "N" for one in turns) if torques else "A"
        what = f"Positions in {each}; efforts in {efforts}, in this order."
    return f"{start}{whose}. {what}" if start else what


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
    if knows_warmth(program.friction):
        step = TAKE_WARMTH + step
    start = '#include "@HEADER@"\n\n#include <math.h>\n#include <stddef.h>\n'
    start += "#include <stdint.h>\n\n" if learned else "\n"
    if "HIL_RESTRICT" in functions:
        start += RESTRICT
    begin = f"\nvoid hil_reset(hil_state *s)\n{{\n    int i;\n{reset}}}\n"
    return start + constants + scale + functions + begin + step
