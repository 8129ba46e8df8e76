"""C that others' tools take: C++ and MSVC words, names of files, coefficients that are 0, units."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.export.c import RESERVED, c_source
from hil.export.c_compiler import STRICT, asked, compiler
from hil.export.program import program_of
from tests.support.export_arms import fitted_arm
from tests.support.export_c_folders import fitted
from tests.support.json_models import fitted as small

KINDS = (
    "rigid-wls", "rigid-wls hard", "rigid-irls", "rigid-diffnea power", "rigid-diffnea memory",
    "lagrangian", "lagrangian coulomb", "lagrangian dissipative",
)  # fmt: skip
FOLDERS = ("friction with memory", "residual network", "Lagrangian network")

MATH_H = {
    "rigid-wls": "sin cos tanh",
    "rigid-wls hard": "sin cos",
    "friction with memory": "sin cos tanh exp log fabs",
    "rigid-diffnea memory": "sin cos tanh exp log fabs",
    "residual network": "sin cos tanh",
    "lagrangian": "sin cos tanh exp log fabs fabsf copysignf",
    "lagrangian dissipative": "sin cos log fabs sqrt fabsf copysignf",
    "Lagrangian network": "sin cos exp log fabs log1p copysign",
}
"""What docs say a runtime has to have."""


def source_of(kind):
    return c_source(program_of(fitted(kind) if kind in FOLDERS else small(kind)))


def refused(source, folder, *command):
    """What a compiler says of header and source; empty if it takes them."""
    (folder / "hil.h").write_text(source.header, "utf-8")
    (folder / "hil.c").write_text(source.source, "utf-8")
    done = subprocess.run([*command, "-c", "hil.c"], cwd=folder, capture_output=True, text=True)
    return done.stderr if done.returncode else ""


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [*KINDS, *FOLDERS])
def test_every_kind_is_cpp_as_well(kind, tmp_path) -> None:
    if shutil.which("g++") is None:
        pytest.skip("there is no C++ compiler")
    strict = ("-x", "c++", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")
    assert refused(source_of(kind), tmp_path, "g++", *strict) == ""


@pytest.mark.parametrize("kind", MATH_H)
def test_docs_name_the_functions_of_math_h_that_it_calls(kind) -> None:
    words = "(?:sin|cos|tan|tanh|exp|log|log1p|sqrt|pow|floor|copysign|fabs)f?"
    called = set(re.findall(rf"(?<![a-z_])({words})\(", source_of(kind).source))
    assert called <= set(MATH_H[kind].split())


@pytest.mark.thorough
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("share", [0.0, 0.02, 0.05, 0.15])
def test_coefficients_that_are_exactly_0_leave_nothing_unused(share, tmp_path) -> None:
    program = program_of(fitted("friction with memory"))
    random = np.random.default_rng(round(1000 * share))
    kept = [np.where(random.random(c.shape) < share, c, 0.0) for c in program.friction.coefficients]
    source = c_source(replace(program, friction=replace(program.friction, coefficients=kept)))
    (tmp_path / "hil.h").write_text(source.header, "utf-8")
    (tmp_path / "hil.c").write_text(source.source, "utf-8")
    done = asked([*STRICT, "-O1", "-c", "hil.c"], tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("prefix", ["test", "all", "stdio", "stddef", "stdint", "math", "int"])
def test_a_prefix_that_cmake_or_c_needs_is_refused(prefix) -> None:
    assert prefix in RESERVED
    with pytest.raises(SpecError, match="for something else"):
        c_source(program_of(small("rigid-wls")), prefix)


def test_joints_that_slide_have_units_of_their_own(tmp_path) -> None:
    program = program_of(fitted_arm("sliding", tmp_path))
    turns = [bool(one) for one in program.geometry.turns]
    assert not all(turns)
    header = c_source(program).header
    assert ", ".join("rad" if one else "m" for one in turns) in header
    assert ", ".join("N*m" if one else "N" for one in turns) in header
    currents = c_source(replace(program, effort_kind="current")).header
    assert "efforts in A" in currents
    assert "Angles in rad, efforts in A." in source_of("rigid-wls").header
