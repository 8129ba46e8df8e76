"""Programs in C in others' hands: compilers, sanitizers, odd numbers, stacks, CMake, C++."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.export.c import export_c
from hil.export.c_compiler import compiler, stack_bytes
from tests.support.c_programs import (
    COMPILERS,
    SANITIZED,
    TEXTS,
    Build,
    compiled,
    require_sanitizers,
)
from tests.support.export_models import fitted

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

MEMORY = "rigid-hysteresis every group"
MOST_BYTES = {MEMORY: 2560, "residual folds": 3840, "lagrangian: stribeck dahl": 6144}
"""Of stack at -O2, what docs say."""

MATH_H_BYTES = 256
"""Of stack, what sin, cos, exp and log take."""

FLAGS = {
    "debugged": ("-O0",),
    "usual": ("-O2",),
    "fast": ("-O3", "-march=native"),
    # By default clang takes no care of traps: it divides in lanes that nobody reads.
    "trapping": ("-O2", "-ffp-exception-behavior=maytrap"),
    "sanitized": SANITIZED,
}
MATRIX = [
    *((kind, name, how) for kind in MOST_BYTES for name in COMPILERS for how in FLAGS
      if how != "trapping" or name == "clang"),
    *((kind, "gcc", "sanitized") for kind in
      ("rigid-diffnea memory", "lagrangian: dissipative", "lagrangian: tanh")),
]  # fmt: skip
"""Kind of model, compiler and flags."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> Callable[[str], Path]:
    """By kind, the folder of its program; each written once."""
    made: dict[str, Path] = {}

    def of(kind: str) -> Path:
        if kind not in made:
            out = tmp_path_factory.mktemp("folder") / "c"
            made[kind] = export_c(fitted(kind), out, unchecked=True).out
        return made[kind]

    return of


@pytest.fixture(scope="module", params=MATRIX, ids=lambda one: "-".join(one))
def built(request, folders, tmp_path_factory) -> tuple[str, str, str, Build]:
    """A program built by a compiler with flags, once for all that is asked of it."""
    kind, name, how = request.param
    out = tmp_path_factory.mktemp("built")
    if how == "sanitized":
        require_sanitizers(name, out)
    return kind, name, how, Build(folders(kind), out, name, FLAGS[how])


@pytest.mark.thorough
def test_it_compiles_without_a_warning_and_its_self_test_passes(built) -> None:
    assert "largest difference" in built[3].self_test()


@pytest.mark.thorough
def test_odd_numbers_are_refused_and_stop_nothing(built) -> None:
    """With traps armed: a division by zero, an invalid operation or an overflow would kill it."""
    *_, name, how, build = built
    if name == "clang" and how in ("usual", "fast"):
        pytest.skip("clang takes care of traps with maytrap alone")
    assert build.ran(TEXTS / "odd_numbers.c") == "nothing stops it\n"


@pytest.mark.thorough
def test_no_call_takes_more_stack_than_is_said(built, tmp_path, monkeypatch) -> None:
    kind, name, how, build = built
    if how in ("sanitized", "trapping"):
        pytest.skip("a program for use is built otherwise")
    used = int(build.ran(TEXTS / "stack.c"))
    monkeypatch.setenv("CC", name)
    shutil.copytree(build.source, tmp_path / "c")
    said = stack_bytes(tmp_path / "c", "hil", FLAGS[how])
    assert said is not None
    assert 0.5 * said < used <= said + MATH_H_BYTES
    if how == "usual":
        assert 1000 < said <= MOST_BYTES[kind]


def test_a_stack_that_grows_without_bound_is_not_said_to_have_one(tmp_path) -> None:
    (tmp_path / "hil.c").write_text(
        "void use(char *); void hil_step(int n); void hil_step(int n) { char a[n]; use(a); }\n"
    )
    assert stack_bytes(tmp_path, "hil") is None


@pytest.mark.thorough
@pytest.mark.parametrize("name", COMPILERS)
def test_cmake_builds_it_and_its_self_test_passes(name, folders, tmp_path) -> None:
    if shutil.which("cmake") is None or shutil.which(name) is None:
        pytest.skip(f"cmake or {name} is not installed")
    source = folders("rigid-wls hard on sliding")
    for command in (
        ["cmake", "-S", str(source), "-B", str(tmp_path), f"-DCMAKE_C_COMPILER={name}"],
        ["cmake", "--build", str(tmp_path)],
        ["ctest", "--test-dir", str(tmp_path), "--no-tests=error"],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert "100% tests passed" in done.stdout


CALLER = """
#include "hil.h"
int main()
{
    hil_state state;
    double q[HIL_N] = {}, effort[HIL_N];
    hil_reset(&state);
    return hil_step(&state, q, q, q, effort, nullptr);
}
"""


@pytest.mark.parametrize("name", COMPILERS)
def test_a_program_in_cpp_calls_it(name, folders, tmp_path) -> None:
    cpp = {"gcc": "g++", "clang": "clang++"}[name]
    source = folders("rigid-wls hard on sliding")
    (tmp_path / "main.cpp").write_text(CALLER, "utf-8")
    compiled(name, ["-c", source / "hil.c", "-o", "hil.o"], tmp_path)
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{source}"]
    compiled(cpp, [*strict, "hil.o", "main.cpp", "-lm", "-o", "made"], tmp_path)
    assert subprocess.run([tmp_path / "made"]).returncode == 0
