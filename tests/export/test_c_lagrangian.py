"""Lagrangian networks as C: the same numbers in every setting, no warnings, nothing undefined."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from tests.support.residual_models import SHORT, SMALL
from tests.support.synthetic_motion import LOAD, moving, nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.control.predictor import Predictor
from hil.core.errors import FitError
from hil.estimators import estimator
from hil.export.agreement import motion
from hil.export.c import c_source, export_c
from hil.export.c_compiler import STRICT, compile_program, compiler, run_self_test
from hil.export.program import program_of
from tests.support.lagrangian_models import CASES, QUICK, lagrangian

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

SANITIZED = (
    "-g", "-fno-sanitize-recover=all",
    "-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow",
)  # fmt: skip

FAR = """#include "hil.h"
#include <math.h>
#include <stddef.h>
int main(void)
{
    static const double at[7] = {0.0, -1e-320, 1e-30, -3.14, 80.0, 1e6, -1e6};
    static hil_state s;
    double q[HIL_N], qd[HIL_N], qdd[HIL_N], effort[HIL_N];
    int i, j;
    hil_reset(&s);
    for (i = 0; i < 49; i++) {
        for (j = 0; j < HIL_N; j++) {
            q[j] = at[(i + j) % 7];
            qd[j] = at[(i / 7 + 2 * j) % 7];
            qdd[j] = at[i % 7];
        }
        if (hil_step(&s, q, qd, qdd, effort, NULL)) { return 1; }
        for (j = 0; j < HIL_N; j++) {
            if (!(fabs(effort[j]) < 1e300)) { return 2; }
        }
    }
    return 0;
}
"""

MIXED = ("stribeck", "dissipative", "unconstrained", "tanh", "silu double")


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_program_says_what_the_network_says(case, tmp_path) -> None:
    told = export_c(lagrangian(case), tmp_path / "out")
    alike = "double" in repr(program_of(lagrangian(case)).lagrangian.kind)
    assert float(told.checked.split()[3]) < (1e-12 if alike else 3e-6)
    remembers = case in ("stribeck dahl", "coulomb dahl")
    assert told.parts == f"lagrangian, {'with' if remembers else 'without'} memory"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_it_compiles_without_warnings_wherever_it_is_asked(name, tmp_path) -> None:
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    for case in MIXED:
        source = c_source(program_of(lagrangian(case)), "arm")
        assert "hil_" not in source.source
        (tmp_path / "arm.h").write_text(source.header, "utf-8")
        (tmp_path / "arm.c").write_text(source.source, "utf-8")
        command = [name, *STRICT, "-O1", "-c", "arm.c", "-o", "arm.o"]
        subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["stribeck dahl", "dissipative", "tanh"])
def test_nothing_undefined_happens_however_far_a_motion_goes(case, tmp_path) -> None:
    """Single precision reaches to 3e38: squares of a million do not leave it."""
    told = export_c(lagrangian(case), tmp_path / "out")
    (told.out / "far.c").write_text(FAR, "utf-8")
    for main in ("far.c", "hil_test.c"):
        try:
            program = compile_program(told.out, ("hil.c", main), "t", SANITIZED)
        except FitError as error:
            if "cannot find" not in error.message:
                raise
            pytest.skip(f"sanitizers cannot be linked: {error.message[:80]}")
        run_self_test(told.out, program)


@pytest.mark.thorough
def test_parts_are_those_of_a_prediction() -> None:
    data = moving(9, load=LOAD, samples=50)
    model = lagrangian("stribeck double")
    wanted = model.predict(data).components
    predictor = Predictor(model, LOAD, compiled=True)
    for k, one in enumerate(zip(data["q_f"], data["qd_f"], data["qdd_f"], strict=True)):
        parts = predictor.explain(*one)
        assert parts["gravity"] == pytest.approx(wanted["gravity"][k], abs=1e-10)
        moved = wanted["inertia"][k] + wanted["coriolis"][k]
        assert parts["inertia"] == pytest.approx(moved, abs=1e-10)
        assert parts["load"] == pytest.approx(wanted["payload"][k], abs=1e-10)
        assert parts["friction"] == pytest.approx(wanted["friction"][k], abs=1e-10)


@pytest.mark.thorough
def test_a_compiled_predictor_is_the_stream() -> None:
    model = lagrangian("coulomb dahl")
    fast, slow = Predictor(model, LOAD), model.stream(LOAD)
    assert fast.compiled
    for one in zip(*motion(nominal(), 120, 50.0), strict=True):
        assert fast.step(*one) == pytest.approx(slow.step(*one), abs=1e-10)


@pytest.mark.thorough
def test_a_residual_network_may_stand_on_one(tmp_path) -> None:
    base = {"estimator": "lagrangian", "network": {"hidden": [12]}, "training": QUICK}
    data = moving(1, 2, 3, 4, noise_a=0.02)
    model = estimator(
        "residual", base=base, network=SMALL, training=SHORT, folds=2, margin=0.0
    ).fit(data, nominal())
    assert model.correction_.kept.any()
    told = export_c(model, tmp_path / "out")
    assert told.parts == "residual, with memory"
    assert float(told.checked.split()[3]) < 1e-5
