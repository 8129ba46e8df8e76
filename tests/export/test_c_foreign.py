"""Names that others chose do not become code: joints, robots, estimators."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hil.control.predictor import Predictor
from hil.export.c import c_source, comment_text, export_c
from hil.export.c_compiler import STRICT, asked, compiler
from hil.export.program import program_of
from tests.support.export_arms import TURNED, fitted_robot, from_text

ODD = ("z*/int x;/*", "/*", "two\nlines", "??/", "behind\\", "a\\\n*/", "\u2028*/", "Gelenk ä")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return fitted_robot(from_text(TURNED, tmp_path_factory.mktemp("arm")))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ODD)
def test_odd_names_stay_in_their_comment(name, model, tmp_path) -> None:
    if compiler() is None:
        pytest.skip("there is no C compiler")
    program = replace(program_of(model), joint_names=("x", name, "r"), estimator=name)
    for told in ("", f"rigid-wls of {name}"):
        source = c_source(program, model_title=told)
        for file, text in (("hil.h", source.header), ("hil.c", source.source)):
            (tmp_path / file).write_text(text, "utf-8")
            assert text.count("/*") == text.count("*/")
            assert text.isascii()
            assert "int x;" not in text
            assert "??" not in text
        done = asked([*STRICT, "-Wtrigraphs", "-c", "hil.c"], tmp_path)
        assert done.returncode == 0, done.stderr


def test_what_names_usually_are_stays_readable() -> None:
    assert comment_text("shoulder_pan-1.5, UR5+ e") == "shoulder_pan-1.5, UR5+ e"


@pytest.mark.thorough
def test_a_model_folder_cannot_bring_code_along(tmp_path) -> None:
    if compiler() is None:
        pytest.skip("there is no C compiler")
    mark = tmp_path / "ran"
    evil = (
        "z */ int system(const char *c); __attribute__((constructor)) static void f(void) "
        f"{{ if (system(&quot;touch {mark}&quot;)) {{}} }} /* "
    )
    model = fitted_robot(from_text(TURNED.replace('name="z"', f'name="{evil}"'), tmp_path))
    assert any("system" in name for name in model.joint_names_)
    export_c(model, tmp_path / "c")
    Predictor(model)
    assert not mark.exists()


def test_a_header_does_not_tell_where_somebody_keeps_files(model, tmp_path) -> None:
    assert "/" in model.robot_.name
    out = export_c(model, tmp_path / "c", unchecked=True).out
    assert "rigid-wls of a.urdf. Written" in (out / "hil.h").read_text("utf-8")
