"""The C that `hil export` writes, portable and for this machine, in a loop of its own."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.prediction.clock import told
from hil.core.typing import FloatArray
from hil.estimators.base import RobotEstimator
from hil.export.c import export_c
from hil.export.c_compiler import asked, compile_program

FLAGS = {"portable": ("-O2",), "native": ("-O3", "-march=native")}

HARNESS = r"""#define _POSIX_C_SOURCE 199309L
#include "hil.h"
#include <math.h>
#include <stdio.h>
#include <time.h>
int main(void)
{
    static hil_state s;
    double q[HIL_N], qd[HIL_N], qdd[HIL_N], effort[HIL_N], sum = 0.0;
    long k;
    int j;
    hil_reset(&s);
    for (k = 0; k < @CALLS@; k++) {
        struct timespec a, b;
        for (j = 0; j < HIL_N; j++) {
            const double w = 2.0 + 0.3 * j, t = (double)k * 1e-3;
            q[j] = 0.8 * sin(w * t + j); qd[j] = 0.8 * w * cos(w * t + j); qdd[j] = -w * w * q[j];
        }
        clock_gettime(CLOCK_MONOTONIC, &a);
        hil_step(&s, q, qd, qdd, effort, NULL);
        clock_gettime(CLOCK_MONOTONIC, &b);
        sum += effort[0];
        printf("%ld\n", (long)(b.tv_sec - a.tv_sec) * 1000000000L + (b.tv_nsec - a.tv_nsec));
    }
    return sum != sum;
}
"""


def timed_c(name: str, model: RobotEstimator, calls: int) -> dict[str, float]:
    """Measure times by compiler flags, and the deviation of the program from the model."""
    figures = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "c"
        checked = export_c(model, folder).checked
        (folder / "harness.c").write_text(HARNESS.replace("@CALLS@", f"{calls}L"), "utf-8")
        for how, flags in FLAGS.items():
            program = compile_program(folder, ("harness.c", "hil.c"), f"bench_{how}", flags)
            # `export_c` compares the portable one; its self-test is built again for the other.
            off = checked if how == "portable" else _self_tested(folder, flags)
            figures[f"{name}_{how}_off_by"] = float(off.split("difference ")[1].split()[0])
            figures |= told(f"{name}_{how}", _printed(program))
    return figures


def build_of(how: str) -> str:
    """Return flags and compiler as text."""
    version = asked(("--version",), Path()).stdout.partition("\n")[0]
    return f"C, {' '.join(FLAGS[how])}, {version}"


def _self_tested(folder: Path, flags: tuple[str, ...]) -> str:
    from hil.export.c_compiler import run_self_test

    return run_self_test(folder, compile_program(folder, ("hil_test.c", "hil.c"), "tested", flags))


def _printed(program: Path) -> FloatArray:
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    return np.array(said.split(), dtype=np.float64)
