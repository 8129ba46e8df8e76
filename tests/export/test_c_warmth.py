"""How warm joints are, told to a program in C: what predict says of recorded temperatures."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from hil.control.predictor import CompiledProgram, Pointer
from hil.estimators import estimator
from hil.estimators.base import prepared
from hil.export.c import c_source
from hil.export.c_compiler import compiler
from hil.export.program import program_of
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import nominal

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
GROUPS = ["core", "load", "temperature"]


@pytest.fixture(scope="module")
def model():
    data = remembering(1, 2, 3, celsius=(20.0, 45.0))
    return estimator("rigid-hysteresis", consistent=False, friction=GROUPS).fit(data, nominal())


def warmed(program: CompiledProgram, kelvin: np.ndarray) -> int:
    return program._library.hil_set_warmth(program._where, Pointer(kelvin.ctypes.data))


KELVIN = np.array([10.0, -5.0, 0.0, 3.0, 1.0, 20.0])


@pytest.mark.thorough
def test_warmer_joints_are_a_training_that_was_so_warm(model) -> None:
    data = prepared(remembering(5), model.filters_)
    program, twin = CompiledProgram(model), copy.copy(model)
    twin.law_ = replace(model.law_, celsius=model.law_.celsius + KELVIN)
    stream = twin.stream()
    assert warmed(program, KELVIN) == 0
    for k in range(100):
        sample = (data["q"][k], data["qd_f"][k], data["qdd_f"][k])
        assert np.allclose(program.step(*sample), stream.step(*sample), rtol=0, atol=1e-10)


def test_what_predict_adds_for_recorded_temperatures_the_program_adds(model) -> None:
    data = prepared(remembering(5), model.filters_)
    program = CompiledProgram(model)
    wanted, found = [], []
    for warmer in (np.zeros(6), KELVIN):
        celsius = np.tile(model.law_.celsius + warmer, (len(data["q"]), 1))
        wanted.append(model.predict(data.with_columns(temperature=celsius)).effort[:200])
        program.reset()
        assert warmed(program, warmer) == 0
        rows = zip(data["q"][:200], data["qd_f"][:200], data["qdd_f"][:200], strict=True)
        found.append(np.array([program.step(*row).copy() for row in rows]))
    adds, says = wanted[1] - wanted[0], found[1] - found[0]
    assert np.abs(adds).max() > 0.01
    # Around reversals predict knows the way ahead, a program does not.
    assert np.sum(says * adds) / np.sum(adds * adds) == pytest.approx(1.0, abs=0.02)
    assert np.median(np.abs(says - adds)) < 1e-3 * np.abs(adds).max()


@pytest.mark.thorough
@pytest.mark.parametrize("bad", [np.nan, np.inf, 2e6])
def test_what_is_no_temperature_is_refused_and_changes_nothing(bad, model) -> None:
    program, twin = CompiledProgram(model), CompiledProgram(model)
    for one in (program, twin):
        assert warmed(one, np.full(6, 7.0)) == 0
    assert warmed(program, np.array([1.0, 2.0, bad, 4.0, 5.0, 6.0])) == -1
    sample = np.full((3, 6), 0.3)
    assert np.array_equal(program.step(*sample), twin.step(*sample))


@pytest.mark.thorough
def test_only_programs_that_depend_on_it_have_it(model) -> None:
    assert "int hil_set_warmth(hil_state *s" in c_source(program_of(model)).header
    plain = estimator("rigid-hysteresis", consistent=False, friction=GROUPS[:2])
    other = c_source(program_of(plain.fit(remembering(1, 2), nominal())))
    assert "warm" not in other.header + other.source
