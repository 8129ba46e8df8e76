"""Programs in C are fed what no controller should feed them, with traps armed and sanitizers on."""

from __future__ import annotations

import pytest

from hil.export.c_compiler import compiler
from tests.support.export_c_folders import COMPILERS, KINDS, SANITIZED, compiled, written
from tests.support.export_c_fuzz import FUZZ

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

OPTIMISED = {
    "gcc": ("-O2",),
    # By default clang takes no care of traps: it divides in lanes that nobody reads.
    "clang": ("-O2", "-ffp-exception-behavior=maytrap"),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}

    def folder(kind):
        if kind not in made:
            made[kind] = written(kind, tmp_path_factory.mktemp("hostile") / "c").out
        return made[kind]

    return folder


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", COMPILERS)
def test_the_self_test_does_nothing_undefined(name, kind, folders, tmp_path) -> None:
    assert "largest difference" in compiled(name, folders(kind), tmp_path, *SANITIZED)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", COMPILERS)
def test_odd_numbers_make_it_do_nothing_undefined(name, kind, folders, tmp_path) -> None:
    said = compiled(name, folders(kind), tmp_path, *SANITIZED, also=FUZZ)
    assert said == "nothing stops it\n"


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", COMPILERS)
def test_odd_numbers_do_not_stop_a_runtime_that_traps(name, kind, folders, tmp_path) -> None:
    """As built for use: a division by zero, an invalid operation or an overflow would kill it."""
    said = compiled(name, folders(kind), tmp_path, *OPTIMISED[name], also=FUZZ)
    assert said == "nothing stops it\n"
