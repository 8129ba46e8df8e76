"""The self-test that is written beside a program: golden vectors, and who built it."""

from __future__ import annotations

import numpy as np

from hil.deploy.export.c_program import CSource
from hil.deploy.export.c_text import array, number
from hil.deploy.export.golden import AGREES, LOAD, Golden


def self_test(source: CSource, golden: Golden) -> str:
    """`PREFIX_test.c`: exits with 0 if the program agrees with the model, and says by how much."""
    inputs = np.stack([golden.q, golden.qd, golden.qdd], axis=1)
    wanted = np.stack([golden.bare, golden.loaded])
    largest = np.maximum(np.abs(wanted).max(axis=(0, 1)), 1e-9)
    inertia = np.array(LOAD.inertia)
    return TEST.format(
        header=f"{source.prefix}.h",
        constants=array("inputs", inputs) + array("wanted", wanted) + array("largest", largest)
        + array("com", np.array(LOAD.com)) + array("inertia", inertia),
        samples=len(golden.q),
        mass=number(LOAD.mass),
        most=number(AGREES),
        p=source.prefix,
        P=source.prefix.upper(),
    )  # fmt: skip


def cmake(source: CSource) -> str:
    """`CMakeLists.txt`: a static library and its self-test."""
    return CMAKE.format(p=source.prefix)


TEST = """/* Golden vectors of the model in Python. Build it with {p}.c and run it. */
#include "{header}"

#include <math.h>
#include <stdio.h>

{constants}
int main(void)
{{
    {p}_state state;
    double effort[{P}_N], worst = 0.0;
    int load, i, j, wrong = 0;
    for (load = 0; load < 2; load++) {{
        {p}_reset(&state);
        if (load && {p}_set_load(&state, {mass}, com, inertia)) {{ return 2; }}
        for (i = 0; i < {samples}; i++) {{
            if ({p}_step(&state, inputs[i][0], inputs[i][1], inputs[i][2], effort, NULL)) {{
                return 2;
            }}
            for (j = 0; j < {P}_N; j++) {{
                const double off = fabs(effort[j] - wanted[load][i][j]) / largest[j];
                /* Numbers behind one that is none do not make up for it. */
                if (!(off <= {most})) {{ wrong = 1; }}
                if (!(off <= worst)) {{ worst = off; }}
            }}
        }}
    }}
    printf("largest difference %.2e of each joint's largest effort\\n", worst);
    if (wrong) {{ return 1; }}
    printf("%lu bytes of state\\n", (unsigned long)sizeof state);
    return 0;
}}
"""

CMAKE = """cmake_minimum_required(VERSION 3.10)
project({p} C)
set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
add_library({p} STATIC {p}.c)
target_include_directories({p} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
find_library(MATH m)
if(MATH)
  target_link_libraries({p} PUBLIC ${{MATH}})
endif()
enable_testing()
add_executable({p}_test {p}_test.c)
target_link_libraries({p}_test {p})
add_test(NAME golden COMMAND {p}_test)
"""
