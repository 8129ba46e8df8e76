"""Models as C: the same numbers, no warnings, no undefined behaviour, clear refusals."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest

from hil.core.errors import FitError, PluginError, RecordingError, SpecError
from hil.estimators import estimator
from hil.estimators.friction_library import groups
from hil.export.agreement import golden_of
from hil.export.c import array_literal, c_source, export_c, literal
from hil.export.c_compiler import STRICT, compile_program, compiler, run_self_test
from hil.export.program import GROUPS, program_of
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import moving, nominal

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

KINDS = {
    "rigid-wls": {},
    "rigid-wls hard sign": {"sign_width": 0.0},
    "rigid-irls": {},
    "rigid-hysteresis": {"consistent": False},
    "rigid-hysteresis everything": {"consistent": False, "friction": list(GROUPS)},
}


@pytest.fixture(scope="module")
def models():
    made = {}

    def fitted(kind: str):
        if kind not in made:
            name = kind.split()[0]
            data = remembering(1, 2, 3) if name == "rigid-hysteresis" else moving(1, 2, 3)
            made[kind] = estimator(name, **KINDS[kind]).fit(data, nominal())
        return made[kind]

    return fitted


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_a_program_says_what_the_model_says(kind, models, tmp_path) -> None:
    told = export_c(models(kind), tmp_path / "out")
    assert float(told.checked.split()[3]) < 1e-12
    assert sorted(p.name for p in told.out.iterdir()) == sorted(told.files)


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_it_compiles_without_warnings_wherever_it_is_asked(name, models, tmp_path) -> None:
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    told = export_c(models("rigid-hysteresis everything"), tmp_path / "out", prefix="arm")
    for flags in (("-O0",), ("-O3", "-march=native")):
        command = [name, *STRICT, *flags, "arm.c", "arm_test.c", "-lm", "-o", "t"]
        subprocess.run(command, cwd=told.out, check=True)
        assert "largest difference" in run_self_test(told.out, told.out / "t")


@pytest.mark.thorough
@needs_compiler
def test_it_does_nothing_undefined(models, tmp_path) -> None:
    told = export_c(models("rigid-hysteresis everything"), tmp_path / "out")
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    try:
        program = compile_program(told.out, ("hil.c", "hil_test.c"), "t", flags)
    except FitError as error:
        pytest.skip(f"sanitizers cannot be linked: {error.message[:80]}")
    assert "largest difference" in run_self_test(told.out, program)


@pytest.mark.thorough
@needs_compiler
def test_the_self_test_fails_for_another_model(models, tmp_path) -> None:
    told = export_c(models("rigid-wls"), tmp_path / "out")
    source = (told.out / "hil.c").read_text("utf-8")
    bent = source.replace("hil_scale[6] = {", "hil_scale[6] = {1.001 * ", 1)
    assert bent != source
    (told.out / "hil.c").write_text(bent, "utf-8")
    with pytest.raises(FitError, match="does not agree with the model"):
        run_self_test(told.out, compile_program(told.out, ("hil.c", "hil_test.c"), "t"))


def test_every_group_of_the_friction_library_can_be_written() -> None:
    assert set(GROUPS) == set(groups(ripple=True, temperature=True))


def test_numbers_come_back_to_the_same_bits() -> None:
    random = np.random.default_rng(0)
    values = random.normal(size=50) * 10.0 ** random.integers(-300, 300, 50)
    assert all(float(literal(value)) == value for value in values)
    single = values.clip(-1e30, 1e30).astype(np.float32)
    assert all(np.float32(literal(v, "float").rstrip("f")) == v for v in single)
    assert "a[2][2] = {\n{1.0, 2.0},\n{3.0, 4.0}};" in array_literal(
        "a", np.array([[1, 2], [3, 4]])
    )
    with pytest.raises(ValueError, match="nan"):
        literal(float("nan"))
    with pytest.raises(ValueError, match="1e\\+300 cannot be a constant"):
        literal(1e300, "float")


def test_symbols_carry_the_prefix(models) -> None:
    source = c_source(program_of(models("rigid-wls")), "left_arm")
    for text in (source.header, source.source):
        assert "hil_" not in text
        assert "HIL_" not in text
    assert "int left_arm_step(" in source.header


@pytest.mark.parametrize("prefix", ["Arm", "1st", "a-b", "", "x" * 40, "a b"])
def test_a_prefix_that_is_no_name_in_c_is_refused(prefix, models) -> None:
    with pytest.raises(SpecError, match="cannot begin the names of C functions"):
        c_source(program_of(models("rigid-wls")), prefix)


def test_what_exists_is_not_written_over(models, tmp_path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(RecordingError, match="exists already"):
        export_c(models("rigid-wls"), tmp_path / "out")


def test_without_a_compiler_only_what_is_said_to_be_unchecked_is_written(
    models, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(PluginError, match="no C compiler"):
        export_c(models("rigid-wls"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    told = export_c(models("rigid-wls"), tmp_path / "out", unchecked=True)
    assert told.checked == ""
    assert (tmp_path / "out" / "hil_test.c").is_file()


def test_models_of_other_kinds_are_refused_by_name() -> None:
    with pytest.raises(FitError, match="static-wls is not fitted"):
        program_of(estimator("static-wls"))


def test_golden_motions_turn_round_and_rest(models) -> None:
    golden = golden_of(models("rigid-wls"))
    assert np.all(golden.qd.min(axis=0) < 0)
    assert np.all(golden.qd.max(axis=0) > 0)
    assert np.all(np.sum(golden.qd == 0.0, axis=0) >= 30)
    assert np.all(np.abs(golden.loaded - golden.bare).max(axis=0)[:5] > 0.01)
