"""The self-test beside a program finds out what is wrong with it."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from hil.export.agreement import DOUBLE, SINGLE, closeness, golden_of, precision
from hil.export.c_compiler import compiler
from hil.export.program import program_of
from tests.support.export_c_folders import fitted, written

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

MEMORY, NETWORK = "friction with memory", "residual network"

MUTANTS = {
    "ways against the velocity count": (MEMORY, "way * v > 0.0 ?", "way != 0.0 ?"),
    "parts are not the effort's": (
        MEMORY, "parts->friction[i] = friction[i] * hil_scale[i]", "parts->friction[i] = 2.0",
    ),
    "gravity is not turned": (MEMORY, "parts->gravity[i] *= hil_scale[i];", ""),
    "samples are not looked at": (MEMORY, "!hil_finite(q, HIL_N) || !", "!hil_finite(q, 0) || !"),
    "loads are not looked at": (MEMORY, "|| mass < 0.0", ""),
    "a load leaves traces": (MEMORY, "    if (!hil_finite(&mass, 1)", "    s->load[0] = mass;\n"
                             "    if (!hil_finite(&mass, 1)"),
    "taps are one row off": (
        NETWORK, "const int at = row + i * apart;",
        "const int at = row + (i ? i * apart - 1 : 0);",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}

    def folder(kind):
        if kind not in made:
            made[kind] = written(kind, tmp_path_factory.mktemp("self") / "c").out
        return made[kind]

    return folder


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("mutant", MUTANTS)
def test_it_fails_where_something_is_wrong(mutant, folders, tmp_path) -> None:
    kind, old, new = MUTANTS[mutant]
    folder = tmp_path / "c"
    shutil.copytree(folders(kind), folder)
    source = (folder / "hil.c").read_text("utf-8")
    assert old in source
    for text, wanted in ((source, 0), (source.replace(old, new, 1), 1)):
        (folder / "hil.c").write_text(text, "utf-8")
        command = ["cc", "-std=c99", "-w", "hil.c", "hil_test.c", "-lm", "-o", "made"]
        subprocess.run(command, cwd=folder, check=True)
        assert subprocess.run([str(folder / "made")], capture_output=True).returncode == wanted


def test_double_precision_is_held_to_more_than_single() -> None:
    assert precision(program_of(fitted(MEMORY))) == DOUBLE
    assert precision(program_of(fitted(NETWORK))) == DOUBLE
    program = program_of(fitted("Lagrangian network"))
    for kind, wanted in (("double", DOUBLE), ("float", SINGLE)):
        kept = replace(program, lagrangian=replace(program.lagrangian, kind=kind))
        assert precision(kept) == wanted


def test_a_residual_is_judged_by_its_own_size() -> None:
    model = fitted(NETWORK)
    golden = golden_of(model, 60)
    limits = closeness(program_of(model), golden)
    own = np.abs(golden.residuals).max(axis=(0, 1))
    assert np.any(own > 0)
    assert np.all(limits.residual <= 1.1e-5 * np.maximum(own, 1e-4 * limits.largest))
    inner = golden_of(model.base_, 60)
    assert np.allclose(golden.bare - golden.residuals[0], inner.bare, rtol=0, atol=1e-12)
    assert inner.residuals is None
