"""C of arms of every build: coupled motors, seven joints, joints that slide."""

from __future__ import annotations

import numpy as np
import pytest

from hil.control.predictor import Predictor
from hil.export.agreement import LOAD, motion
from hil.export.c import export_c
from hil.export.c_compiler import compiler
from hil.export.program import program_of
from tests.support.export_arms import ARMS, fitted_arm

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("arms")


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("arm", ARMS)
def test_a_program_says_what_the_model_says(arm, folder, tmp_path) -> None:
    told = export_c(fitted_arm(arm, folder), tmp_path / "c")
    assert float(told.checked.split()[3]) < 1e-12


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("load", [None, LOAD])
def test_a_predictor_says_it_too(arm, load, folder) -> None:
    model = fitted_arm(arm, folder)
    fast, slow = (Predictor(model, load, compiled=how) for how in (True, False))
    rows = list(zip(*motion(model.robot_, 50, 250.0), strict=True))
    found, wanted = (np.array([p.step(*row).copy() for row in rows]) for p in (fast, slow))
    assert np.allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())
    parts = fast.explain(*rows[-1])
    assert sum(parts.values()) == pytest.approx(slow.step(*rows[-1]), abs=1e-9)


def test_only_coupled_motors_have_a_coupling(folder) -> None:
    T = program_of(fitted_arm("tx40@motors", folder)).coupling
    assert T is not None
    assert not np.array_equal(T, np.eye(6))
    assert program_of(fitted_arm("panda", folder)).coupling is None
