"""The rigid body as C: recursive Newton–Euler in the joints' own frames.

Luh, Walker & Paul (1980). Torques are linear in the bodies' parameters, so one walk outwards places
and accelerates the links, and two walks inwards sum up what hangs on each joint: once with the
model's bodies, once with those whose torque the gears transmit. A load is one more body in the
last link, the same in both.
"""

from __future__ import annotations

import numpy as np

from hil.export.c_rigid_text import COUPLED, FUNCTIONS
from hil.export.c_text import Piece, array
from hil.export.program import Program


def rigid_piece(program: Program) -> Piece:
    """Functions `hil_move`, `hil_collect` and `hil_mount`, and the constants they need."""
    geometry = program.geometry
    own_gears = not np.array_equal(program.gears, program.rigid)
    constants = [
        array("hil_turn", geometry.placement[:, :3, :3]),
        array("hil_shift", geometry.placement[:, :3, 3]),
        array("hil_axis", geometry.axis),
        "static const int hil_turns[HIL_N] = {"
        + ", ".join(str(int(turns)) for turns in geometry.turns)
        + "};\n",
        array("hil_gravity", program.gravity),
        array("hil_flange", program.flange[:3]),
        array("hil_bodies", program.rigid),
    ]
    if own_gears:
        constants.append(array("hil_gears", program.gears))
    if program.coupling is not None:
        constants.append(array("hil_coupling", program.coupling))
    return Piece(
        constants="".join(constants),
        state="    double load[10]; /* mass, first moment, inertia in the last link's frame */\n",
        functions=_functions(program.coupling is not None),
        reset="    for (i = 0; i < 10; i++) { s->load[i] = 0.0; }\n",
    )


def bodies_of_gears(program: Program) -> str:
    """Name of the array with the bodies whose torque the gears transmit."""
    return "hil_bodies" if np.array_equal(program.gears, program.rigid) else "hil_gears"


def _functions(coupled: bool) -> str:
    code = FUNCTIONS
    for word, text in COUPLED.items():
        code = code.replace(word, text if coupled else "")
    return code
