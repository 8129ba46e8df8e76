"""rigid-diffnea as C, with every form of its friction; what models at rest are told."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.estimators import estimator
from hil.estimators.diffnea_friction import FORMS
from hil.export.c import export_c
from hil.export.c_compiler import compile_program, compiler, run_self_test
from hil.export.program import program_of
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import moving, nominal

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def models():
    made = {}

    def fitted(friction: str, **params):
        key = (friction, *params)
        if key not in made:
            data = remembering(1, 2) if friction == "memory" else moving(1, 2)
            made[key] = estimator("rigid-diffnea", friction=friction, **params).fit(data, nominal())
        return made[key]

    return fitted


@pytest.mark.thorough
@pytest.mark.parametrize("friction", FORMS)
def test_a_program_says_what_the_model_says(friction, models, tmp_path) -> None:
    told = export_c(models(friction), tmp_path / "out")
    assert float(told.checked.split()[3]) < 1e-12
    assert told.parts.endswith(" with memory") == (friction == "memory")


@pytest.mark.thorough
def test_a_hard_sign_is_hard_in_c_too(models, tmp_path) -> None:
    told = export_c(models("stribeck-power", sign_width=0.0), tmp_path / "out")
    assert float(told.checked.split()[3]) < 1e-12
    assert "tanh(" not in (told.out / "hil.c").read_text("utf-8")


@pytest.mark.thorough
def test_it_does_nothing_undefined(models, tmp_path) -> None:
    told = export_c(models("memory"), tmp_path / "out")
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    try:
        program = compile_program(told.out, ("hil.c", "hil_test.c"), "t", flags)
    except FitError as error:
        pytest.skip(f"sanitizers cannot be linked: {error.message[:80]}")
    assert "largest difference" in run_self_test(told.out, program)


def test_gears_carry_what_the_fit_took_them_to(models) -> None:
    """Friction with load was fitted to the torque of an earlier round's bodies."""
    program = program_of(models("memory"))
    assert (program.gears != program.rigid).any()


def test_a_model_of_rests_says_what_else_there_is() -> None:
    for name in ("static-wls", "static-linear", "static-mlp-lm"):
        model = estimator(name)
        model.sigma_ = np.zeros(6)
        with pytest.raises(FitError, match="at rest") as refused:
            program_of(model)
        assert "HandGuiding" in str(refused.value)
        assert "--to json" in str(refused.value)
