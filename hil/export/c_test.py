"""The self-test that is written beside a program: golden vectors, and who built it."""

from __future__ import annotations

import numpy as np

from hil.export.c_program import PARTS, CSource
from hil.export.c_test_text import CMAKE, NO_RESIDUAL, RESIDUAL, TEST
from hil.export.c_text import array, number
from hil.export.golden import LOAD, Golden
from hil.export.program import Program
from hil.export.tolerances import NETWORK, closeness, precision


def self_test(source: CSource, program: Program, golden: Golden) -> str:
    """`PREFIX_test.c`: exits with 0 if the program agrees with the model, and says by how much."""
    inputs = np.stack([golden.q, golden.qd, golden.qdd], axis=1)
    wanted = np.stack([golden.bare, golden.loaded])
    limits = closeness(program, golden)
    arrays = {
        "inputs": inputs,
        "wanted": wanted if golden.residuals is None else wanted - golden.residuals,
        "largest": limits.largest,
        "com": np.array(LOAD.com),
        "inertia": np.array(LOAD.inertia),
    }
    if golden.residuals is not None:
        arrays |= {"residuals": golden.residuals, "own": limits.residual / NETWORK}
    return TEST.format(
        header=f"{source.prefix}.h",
        constants="".join(array(name, values) for name, values in arrays.items()),
        samples=len(golden.q),
        mass=number(LOAD.mass),
        most=number(precision(program)),
        sum=" + ".join(f"parts.{name}[j]" for name in PARTS),
        residual=(NO_RESIDUAL if golden.residuals is None else RESIDUAL).format(
            most=number(NETWORK)
        ),
        p=source.prefix,
        P=source.prefix.upper(),
    )


def cmake(source: CSource) -> str:
    """`CMakeLists.txt`: a static library and its self-test."""
    return CMAKE.format(p=source.prefix)
