"""Models as C: every kind's numbers, the text of the program, and the self-test beside it."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.control.predictor import Predictor
from hil.core.errors import DataError, SpecError
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator, prepared
from hil.estimators.friction_library import groups
from hil.export.agreement import LOAD, SINGLE, golden_of, precision
from hil.export.c import RESERVED, array_literal, c_source, comment_text, export_c, literal
from hil.export.c_compiler import STRICT, compiler
from hil.export.program import GROUPS, PlainFriction, program_of
from hil.export.targets import written_as
from tests.support.c_programs import Build, Library, compiled, written
from tests.support.export_models import ARMS, KINDS, SLIDING, fitted, sliding_arm, torques_of
from tests.support.export_readers import off_by, streamed
from tests.support.lagrangian_models import CASES
from tests.support.paths import DOCS
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import LOAD as HEAVIER
from tests.support.synthetic_motion import moving

PAGE = (DOCS / "how-to" / "export-c.md").read_text("utf-8")
needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

MEMORY, NETWORK, WARM = "rigid-hysteresis every group", "residual folds", "rigid-hysteresis warm"
SLIDES, COUPLED, _ = ARMS
PROGRAMS = [
    *(kind for kind in KINDS if kind.startswith("rigid")), "rigid-diffnea hard", WARM, MEMORY,
    "residual none kept", "residual lagrangian", NETWORK, *ARMS,
    *(f"lagrangian: {case}" for case in CASES),
]  # fmt: skip


@pytest.fixture(scope="module", params=PROGRAMS)
def program(request, tmp_path_factory) -> tuple[str, RobotEstimator, Path, Library]:
    """Of every kind: its name, the model, the folder with the source, and the program."""
    model = fitted(request.param)
    folder = written(c_source(program_of(model)), tmp_path_factory.mktemp("c"))
    return request.param, model, folder, Build(folder, folder).library(model.robot_.n)


@pytest.mark.thorough
@needs_compiler
def test_a_program_has_the_efforts_of_the_model_and_its_parts_add_up(program) -> None:
    kind, model, _, library = program
    golden = golden_of(model, 90)
    for load, expected in ((Payload(), golden.bare), (LOAD, golden.loaded)):
        library.reset()
        assert library.mount(load) == 0
        found, sums = [], []
        for row in zip(golden.q, golden.qd, golden.qdd, strict=True):
            found.append(library.step(*row))
            sums.append(library.parts.sum(axis=0))
        single = precision(program_of(model)) == SINGLE
        share = 3e-6 if single else 1e-7 if kind == NETWORK else 1e-12
        assert off_by(np.array(found), expected) < share
        assert off_by(np.array(sums), np.array(found)) < 1e-12


@pytest.mark.thorough
@needs_compiler
def test_a_program_is_cpp_as_well(program) -> None:
    strict = ("-x", "c++", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only")
    compiled("g++", [*strict, "hil.c"], program[2])


FUNCTION = "(?:sin|cos|tan|tanh|exp|log|log1p|sqrt|pow|floor|copysign|fabs)f?"


@pytest.mark.thorough
@needs_compiler
def test_docs_name_the_functions_of_math_h_that_a_program_calls(program) -> None:
    kind, model, folder, _ = program
    source = (folder / "hil.c").read_text("utf-8")
    called = set(re.findall(rf"(?<![a-z_])({FUNCTION})\(", source))
    table = PAGE.partition("## What it needs of `math.h`")[2].partition("##")[0]
    docs = {
        row: set(re.findall(rf"`({FUNCTION})`", functions))
        for row, functions in re.findall(r"\| (.+?) \| (.+) \|", table)
    }
    whole = program_of(model)
    rows = ["every rigid body", "friction with memory, `rigid-diffnea`"]
    if isinstance(whole.friction, PlainFriction):
        rows[1] = "Coulomb and viscous friction"
    if whole.lagrangian is not None:
        double = whole.lagrangian.kind == "double"
        ends = "… in double precision" if double else "Lagrangian network, single precision"
        rows[1:] = [ends, "… its friction"]
    assert called <= set().union(*(docs[row] for row in rows))
    if "rigid" in kind and "hard" in kind:
        assert "tanh" not in called


@pytest.mark.thorough
def test_only_coupled_motors_have_a_coupling() -> None:
    T = program_of(fitted(COUPLED)).coupling
    assert T is not None
    assert not np.array_equal(T, np.eye(6))
    assert program_of(fitted(SLIDES)).coupling is None


@pytest.mark.thorough
def test_gears_carry_what_the_fit_took_them_to() -> None:
    """Friction with load was fitted to the torque of an earlier round's bodies."""
    program = program_of(fitted("rigid-diffnea memory"))
    assert (program.gears != program.rigid).any()


@pytest.mark.thorough
@needs_compiler
def test_a_checked_export_passes_its_self_test_and_says_its_sizes(tmp_path) -> None:
    told = export_c(fitted("rigid-wls"), tmp_path / "out", prefix="arm")
    assert told.files == ("arm.h", "arm.c", "arm_test.c", "CMakeLists.txt")
    assert re.match(r"self-test: largest difference \S+ of each joint's", told.checked)
    assert float(told.checked.split()[3]) < 1e-12
    (note,) = told.notes
    found = re.match(r"at most (\d+) bytes of stack .*, (\d+) bytes of state \(", note)
    assert found is not None
    assert 500 < int(found[1]) < 2560
    assert int(found[2]) >= 8


@pytest.mark.thorough
def test_a_network_that_every_joint_dropped_is_not_written() -> None:
    model = fitted("residual none kept")
    assert not model.correction_.kept.any()
    assert "hil_network" not in c_source(program_of(model)).source
    assert "arm_network" in c_source(program_of(fitted(NETWORK)), "arm").source


# The text of a program.


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


def test_numbers_that_are_none_are_named(tmp_path) -> None:
    damaged = copy.copy(fitted(SLIDES))
    damaged.coefficients_ = damaged.coefficients_ * np.nan
    with pytest.raises(DataError, match="nan cannot be a constant"):
        written_as(damaged, tmp_path / "out", "c", unchecked=True)


def test_every_group_of_the_friction_library_can_be_written() -> None:
    assert set(GROUPS) == set(groups(ripple=True, temperature=True))


def test_symbols_carry_the_prefix() -> None:
    source = c_source(program_of(fitted(SLIDES)), "left_arm")
    for text in (source.header, source.source):
        assert "hil_" not in text
        assert "HIL_" not in text
    assert "int left_arm_step(" in source.header


@pytest.mark.parametrize("prefix", ["Arm", "1st", "a-b", "", "x" * 40, "a b"])
def test_a_prefix_that_is_no_name_in_c_is_refused(prefix) -> None:
    with pytest.raises(SpecError, match="cannot be the prefix of C function names"):
        c_source(program_of(fitted(SLIDES)), prefix)


@pytest.mark.parametrize("prefix", ["test", "all", "stdio", "stddef", "stdint", "math", "int"])
def test_a_prefix_that_cmake_or_c_needs_is_refused(prefix) -> None:
    assert prefix in RESERVED
    with pytest.raises(SpecError, match="is reserved by C or CMake"):
        c_source(program_of(fitted(SLIDES)), prefix)


def test_joints_that_slide_have_units_of_their_own() -> None:
    program = program_of(fitted(SLIDES))
    assert list(program.geometry.turns) == [True, False, True]
    header = c_source(program).header
    assert "Positions in rad, m, rad; efforts in N*m, N, N*m, in this order." in header
    currents = c_source(replace(program, effort_kind="current")).header
    assert "efforts in A" in currents
    turning = replace(program, geometry=replace(program.geometry, turns=np.ones(3, dtype=bool)))
    assert "Angles in rad, efforts in N*m." in c_source(turning).header


ODD = ("z*/int x;/*", "/*", "two\nlines", "??/", "behind\\", "a\\\n*/", "\u2028*/", "Gelenk ä")


@needs_compiler
@pytest.mark.parametrize("name", ODD)
def test_odd_names_stay_in_their_comment(name, tmp_path) -> None:
    program = replace(program_of(fitted(SLIDES)), joint_names=("x", name, "r"), estimator=name)
    for title in ("", f"rigid-wls of {name}"):
        source = c_source(program, model_title=title)
        for text in (source.header, source.source):
            assert text.count("/*") == text.count("*/")
            assert text.isascii()
            assert "int x;" not in text
            assert "??" not in text
        written(source, tmp_path)
        compiled("cc", [*STRICT, "-Wtrigraphs", "-fsyntax-only", "hil.c"], tmp_path)


def test_what_names_usually_are_stays_readable() -> None:
    assert comment_text("shoulder_pan-1.5, UR5+ e") == "shoulder_pan-1.5, UR5+ e"


@pytest.mark.thorough
@needs_compiler
def test_a_model_folder_cannot_bring_code_along(tmp_path) -> None:
    mark = tmp_path / "ran"
    evil = (
        "z */ int system(const char *c); __attribute__((constructor)) static void f(void) "
        f"{{ if (system(&quot;touch {mark}&quot;)) {{}} }} /* "
    )
    text = SLIDING.read_text("utf-8").replace('joint name="z"', f'joint name="{evil}"')
    (tmp_path / "a.urdf").write_text(text, "utf-8")
    robot = sliding_arm(tmp_path / "a.urdf")
    model = estimator("rigid-wls").fit(torques_of(robot), robot)
    assert any("system" in name for name in model.joint_names_)
    export_c(model, tmp_path / "c")
    Predictor(model)
    assert not mark.exists()


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("share", [0.0, 0.02, 0.05, 0.15])
def test_coefficients_that_are_exactly_0_leave_nothing_unused(share, tmp_path) -> None:
    program = program_of(fitted(MEMORY))
    random = np.random.default_rng(round(1000 * share))
    kept = [np.where(random.random(c.shape) < share, c, 0.0) for c in program.friction.coefficients]
    source = c_source(replace(program, friction=replace(program.friction, coefficients=kept)))
    compiled("cc", [*STRICT, "-fsyntax-only", "hil.c"], written(source, tmp_path))


# The self-test beside a program.

SCALED = ("hil_scale[6] = {", "hil_scale[6] = {1.001 * ")
MUTANTS = {
    "another model": (MEMORY, *SCALED),
    "ways against the velocity count": (MEMORY, "way * v > 0.0 ?", "way != 0.0 ?"),
    "parts are not the effort's": (
        MEMORY, "parts->friction[i] = friction[i] * hil_scale[i]", "parts->friction[i] = 2.0",
    ),
    "gravity is not turned": (MEMORY, "parts->gravity[i] *= hil_scale[i];", ""),
    "samples are not looked at": (MEMORY, "!hil_finite(q, HIL_N) || !", "!hil_finite(q, 0) || !"),
    "loads are not looked at": (MEMORY, "|| mass < 0.0", ""),
    "a load leaves traces": (MEMORY, "    if (!hil_finite(&mass, 1)", "    s->load[0] = mass;\n"
                             "    if (!hil_finite(&mass, 1)"),
    "one sample is no number": (
        MEMORY, "    if (parts) {", "    static int count; if (++count == 9) { effort[0] = NAN; }\n"
        "    if (parts) {",
    ),
    "taps are one row off": (
        NETWORK, "const int at = row + i * apart;",
        "const int at = row + (i ? i * apart - 1 : 0);",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def tests_built(tmp_path_factory) -> Callable[[str], Path]:
    """By kind, a folder of C whose self-test is compiled, and passes."""
    made: dict[str, Path] = {}

    def of(kind: str) -> Path:
        if kind not in made:
            folder = made[kind] = tmp_path_factory.mktemp("tests") / "c"
            export_c(fitted(kind), folder, unchecked=True)
            compiled("cc", ["-O0", "-c", "hil_test.c"], folder)
            compiled("cc", ["-O0", "hil.c", "hil_test.o", "-lm", "-o", "honest"], folder)
            assert _exit(folder / "honest") == 0
        return made[kind]

    return of


def _exit(program: Path) -> int:
    return subprocess.run([program], capture_output=True).returncode


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_self_test_fails_where_something_is_wrong(mutant, tests_built, tmp_path) -> None:
    kind, old, new = MUTANTS[mutant]
    folder = tests_built(kind)
    source = (folder / "hil.c").read_text("utf-8")
    assert old in source
    shutil.copy(folder / "hil.h", tmp_path)
    (tmp_path / "hil.c").write_text(source.replace(old, new, 1), "utf-8")
    compiled("cc", ["-w", "-O0", "hil.c", folder / "hil_test.o", "-lm", "-o", "bent"], tmp_path)
    assert _exit(tmp_path / "bent") == 1


@pytest.mark.thorough
@needs_compiler
def test_parts_of_a_lagrangian_network_are_those_of_its_prediction() -> None:
    data = moving(9, load=HEAVIER, samples=50)
    model = fitted("lagrangian: stribeck double")
    expected = model.predict(data).components
    predictor = Predictor(model, HEAVIER, compiled=True)
    for k, one in enumerate(zip(data["q_f"], data["qd_f"], data["qdd_f"], strict=True)):
        parts = predictor.explain(*one)
        moved = expected["inertia"][k] + expected["coriolis"][k]
        assert parts["gravity"] == pytest.approx(expected["gravity"][k], abs=1e-10)
        assert parts["inertia"] == pytest.approx(moved, abs=1e-10)
        assert parts["load"] == pytest.approx(expected["payload"][k], abs=1e-10)
        assert parts["friction"] == pytest.approx(expected["friction"][k], abs=1e-10)


# How warm joints are.

KELVIN = np.array([10.0, -5.0, 0.0, 3.0, 1.0, 20.0])


@pytest.fixture(scope="module")
def warm(tmp_path_factory) -> Callable[[], Library]:
    """Loads a program whose friction depends on temperature, compiled once."""
    folder = written(c_source(program_of(fitted(WARM))), tmp_path_factory.mktemp("warm"))
    build = Build(folder, folder)
    build.library(6)
    return lambda: Library(folder / "hil.so", 6)


def _stepped(library: Library, data: Any, count: int, q: str = "q") -> np.ndarray:
    rows = zip(data[q][:count], data["qd_f"][:count], data["qdd_f"][:count], strict=True)
    return np.array([library.step(*row) for row in rows])


@pytest.mark.thorough
@needs_compiler
def test_warmer_joints_are_a_training_that_was_so_warm(warm) -> None:
    model, program = fitted(WARM), warm()
    data, twin = prepared(remembering(5), model.filters_), copy.copy(model)
    twin.law_ = replace(model.law_, celsius=model.law_.celsius + KELVIN)
    assert program.warm(KELVIN) == 0
    motion = tuple(data[name][:100] for name in ("q", "qd_f", "qdd_f"))
    expected = streamed(twin, motion, Payload())
    assert np.allclose(_stepped(program, data, 100), expected, rtol=0, atol=1e-10)


@pytest.mark.thorough
@needs_compiler
def test_what_predict_adds_for_recorded_temperatures_a_program_adds(warm) -> None:
    model, program = fitted(WARM), warm()
    data = prepared(remembering(5), model.filters_)
    expected, found = [], []
    for warmer in (np.zeros(6), KELVIN):
        celsius = np.tile(model.law_.celsius + warmer, (len(data["q"]), 1))
        expected.append(model.predict(data.with_columns(temperature=celsius)).effort[:200])
        program.reset()
        assert program.warm(warmer) == 0
        found.append(_stepped(program, data, 200))
    adds, says = expected[1] - expected[0], found[1] - found[0]
    assert np.abs(adds).max() > 0.01
    # Around reversals predict knows the way ahead, a program does not.
    assert np.sum(says * adds) / np.sum(adds * adds) == pytest.approx(1.0, abs=0.02)
    assert np.median(np.abs(says - adds)) < 1e-3 * np.abs(adds).max()


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("bad", [np.nan, np.inf, 2e6])
def test_what_is_no_temperature_is_refused_and_changes_nothing(bad, warm) -> None:
    program, twin = warm(), warm()
    for one in (program, twin):
        assert one.warm(np.full(6, 7.0)) == 0
    assert program.warm(np.array([1.0, 2.0, bad, 4.0, 5.0, 6.0])) == -1
    sample = np.full((3, 6), 0.3)
    assert np.array_equal(program.step(*sample), twin.step(*sample))


@pytest.mark.thorough
def test_only_programs_that_depend_on_temperature_take_it() -> None:
    assert "int hil_set_warmth(hil_state *s" in c_source(program_of(fitted(WARM))).header
    other = c_source(program_of(fitted("rigid-hysteresis")))
    assert "warm" not in other.header + other.source
