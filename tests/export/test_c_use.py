"""What a user does with a folder of C: builds it with CMake, calls it from C++, gives it stack."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from hil.export.c_compiler import compiler, stack_bytes
from tests.support.export_c_folders import COMPILERS, KINDS, compiled, written
from tests.support.export_c_stack import STACK

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

MOST_BYTES = {
    "friction with memory": 2560,
    "residual network": 3840,
    "Lagrangian network": 6144,
}
"""Of stack at -O2, what docs say."""

MATH_H_BYTES = 256
"""Of stack, what sin, cos, exp and log take."""

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


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    made = {}

    def program(kind):
        if kind not in made:
            made[kind] = written(kind, tmp_path_factory.mktemp("use") / "c")
        return made[kind]

    return program


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_an_export_says_how_much_stack_and_state_it_takes(kind, programs) -> None:
    found = re.match(
        r"at most (\d+) bytes of stack .*, (\d+) bytes of state \(", *programs(kind).notes
    )
    assert found is not None
    stack, state = (int(size) for size in found.groups())
    assert 1000 < stack <= MOST_BYTES[kind]
    assert state > 6 * 8


@pytest.mark.thorough
@pytest.mark.parametrize("flags", ["-O0", "-O2", "-O3 -march=native"])
@pytest.mark.parametrize("name", COMPILERS)
def test_no_call_takes_more_stack_than_is_said(
    name, flags, programs, tmp_path, monkeypatch
) -> None:
    for kind in KINDS:
        folder = programs(kind).out
        options = ("-std=gnu11", *flags.split(), "-pthread")
        used = int(compiled(name, folder, tmp_path, *options, also=STACK))
        monkeypatch.setenv("CC", name)
        source = tmp_path / kind
        shutil.copytree(folder, source)
        said = stack_bytes(source, "hil", flags.split())
        assert said is not None
        assert 0.5 * said < used <= said + MATH_H_BYTES


def test_a_stack_that_grows_without_bound_is_not_said_to_have_one(tmp_path) -> None:
    (tmp_path / "hil.c").write_text(
        "void use(char *); void hil_step(int n); void hil_step(int n) { char a[n]; use(a); }\n"
    )
    assert stack_bytes(tmp_path, "hil") is None


@pytest.mark.thorough
@pytest.mark.parametrize("name", COMPILERS)
def test_cmake_builds_it_and_its_self_test_passes(name, programs, tmp_path) -> None:
    if shutil.which("cmake") is None or shutil.which(name) is None:
        pytest.skip(f"cmake or {name} is not installed")
    source = programs("friction with memory").out
    for command in (
        ["cmake", "-S", str(source), "-B", str(tmp_path), f"-DCMAKE_C_COMPILER={name}"],
        ["cmake", "--build", str(tmp_path)],
        ["ctest", "--test-dir", str(tmp_path), "--no-tests=error"],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert "100% tests passed" in done.stdout


@pytest.mark.parametrize("name", COMPILERS)
def test_a_program_in_cpp_calls_it(name, programs, tmp_path) -> None:
    cpp = {"gcc": "g++", "clang": "clang++"}[name]
    if shutil.which(name) is None or shutil.which(cpp) is None:
        pytest.skip(f"{cpp} is not installed")
    source = programs("friction with memory").out
    (tmp_path / "main.cpp").write_text(CALLER, "utf-8")
    made = [str(tmp_path / file) for file in ("hil.o", "main.cpp")]
    subprocess.run([name, "-c", str(source / "hil.c"), "-o", made[0]], check=True)
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{source}"]
    subprocess.run([cpp, *strict, *made, "-lm", "-o", str(tmp_path / "made")], check=True)
    assert subprocess.run([str(tmp_path / "made")]).returncode == 0


def test_the_self_test_does_not_lose_what_is_no_number(programs, tmp_path) -> None:
    """One sample that is none, in the middle: what comes behind it is right again."""
    folder = tmp_path / "bent"
    shutil.copytree(programs("friction with memory").out, folder)
    source = (folder / "hil.c").read_text("utf-8")
    bent = source.replace(
        "    if (parts) {", "    static int count; if (++count == 9) { effort[0] = NAN; }\n"
        "    if (parts) {", 1,
    )  # fmt: skip
    assert bent != source
    (folder / "hil.c").write_text(bent, "utf-8")
    command = ["cc", "hil.c", "hil_test.c", "-lm", "-o", "made"]
    subprocess.run(command, cwd=folder, check=True)
    assert subprocess.run([str(folder / "made")], capture_output=True).returncode == 1
