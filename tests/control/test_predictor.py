"""Models in a loop: compiled or not, the same numbers; nothing allocated when compiled."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.control import predictor
from hil.control.predictor import Predictor
from hil.core.errors import DataError, FitError, PluginError, SpecError
from hil.estimators import estimator
from hil.estimators.base import prepared
from hil.export.agreement import motion
from hil.export.c import c_source
from hil.export.c_compiler import compiler
from hil.export.program import NotExported
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import LOAD, nominal

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
Q, QD, QDD = motion(nominal(), 200, 250.0)


@pytest.fixture(scope="module")
def model():
    return estimator("rigid-hysteresis", consistent=False).fit(remembering(1, 2, 3), nominal())


def said(predictor: Predictor) -> np.ndarray:
    return np.array([predictor.step(*one).copy() for one in zip(Q, QD, QDD, strict=True)])


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("load", [None, LOAD])
def test_compiled_or_not_it_says_the_same(load, model) -> None:
    fast, slow = (Predictor(model, load, compiled=how) for how in (True, False))
    assert (fast.compiled, slow.compiled) == (True, False)
    assert np.allclose(said(fast), said(slow), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("path", "load", "words"),
    [("models/m", None, "model is 'models/m', a str"), ("", 1.5, "payload is 1.5, a float")],
)
def test_a_path_or_a_number_is_one_clear_error(path, load, words, model) -> None:
    with pytest.raises(SpecError) as told:
        Predictor(path or model, load)
    assert words in f"{told.value.message} {told.value.hint}"


@needs_compiler
def test_a_reset_forgets_the_way_and_keeps_the_load(model) -> None:
    predictor = Predictor(model, LOAD)
    first = said(predictor)
    assert not np.allclose(said(predictor), first, rtol=0, atol=1e-6)
    predictor.reset()
    assert np.array_equal(said(predictor), first)


@pytest.mark.thorough
@needs_compiler
def test_parts_add_up_to_the_effort(model) -> None:
    predictor = Predictor(model, LOAD)
    for one in zip(Q[:50], QD[:50], QDD[:50], strict=True):
        parts = predictor.explain(*one)
    assert np.abs(parts["load"]).sum() > 0.1
    twin = Predictor(model, LOAD)
    effort = [twin.step(*one).copy() for one in zip(Q[:50], QD[:50], QDD[:50], strict=True)][-1]
    assert sum(parts.values()) == pytest.approx(effort, abs=1e-12)


@needs_compiler
def test_gravity_and_inertia_are_those_of_the_model(model) -> None:
    data = prepared(remembering(5), model.filters_)
    k = 200
    found = model.predict(data).components
    predictor = Predictor(model)
    parts = predictor.explain(data["q_f"][k], data["qd_f"][k], data["qdd_f"][k])
    for name in ("gravity", "inertia"):
        assert parts[name] == pytest.approx(found[name][k], abs=1e-9)


@needs_compiler
def test_in_steady_state_nothing_is_allocated(model) -> None:
    predictor = Predictor(model)
    samples = list(zip(Q, QD, QDD, strict=True))
    for one in samples:
        predictor.step(*one)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for one in samples:
        predictor.step(*one)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 1024


@pytest.mark.thorough
@pytest.mark.parametrize("how", [None, False])
def test_what_cannot_be_is_refused_and_not_remembered(how, model) -> None:
    predictor, twin = (Predictor(model, compiled=how) for _ in range(2))
    for k in range(20):
        for bad in (np.nan, np.inf, 1e7):
            with pytest.raises(DataError, match="not finite"):
                predictor.step(np.full(6, bad), QD[k], QDD[k])
        said = predictor.step(Q[k], QD[k], QDD[k])
        assert np.array_equal(said, twin.step(Q[k], QD[k], QDD[k]))


ODD = (
    0.5, np.array([0.5]), "1", ["1"] * 6, None, [[0.1] * 6], np.zeros((1, 6)), np.zeros(5),
    np.zeros((2, 6)), 1j * np.ones(6), [None] * 6, [0.1, [0.2]] * 3, [True] * 6,
)  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("how", [None, False])
def test_what_is_not_one_number_per_joint_is_refused(how, model) -> None:
    predictor = Predictor(model, compiled=how)
    for bad in ODD:
        for place in range(3):
            sample = [Q[0], QD[0], QDD[0]]
            sample[place] = bad
            with pytest.raises(DataError, match="6 joints"):
                predictor.step(*sample)


@pytest.mark.thorough
@pytest.mark.parametrize("how", [None, False])
def test_lists_and_other_precisions_will_do(how, model) -> None:
    one, other = (Predictor(model, compiled=how) for _ in range(2))
    row = np.float32(Q[0])
    assert np.array_equal(
        one.step(row.tolist(), [0] * 6, QDD[0]), other.step(row, np.zeros(6), QDD[0])
    )


@pytest.mark.thorough
@needs_compiler
def test_a_load_that_is_none_is_refused(model) -> None:
    load = Payload(mass=1.0)
    object.__setattr__(load, "mass", float("nan"))
    with pytest.raises(DataError, match="is not a payload"):
        Predictor(model, load)


def test_without_a_compiler_python_takes_its_place(model, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert not Predictor(model).compiled
    with pytest.raises(PluginError, match="no C compiler"):
        Predictor(model, compiled=True)
    with pytest.raises(FitError, match="compiled predictor"):
        Predictor(model).explain(Q[0], QD[0], QDD[0])


@needs_compiler
def test_models_that_are_not_exported_run_in_python(model, monkeypatch) -> None:
    def refused(_: object) -> None:
        raise NotExported("cannot be exported as a program")

    monkeypatch.setattr(predictor, "program_of", refused)
    assert not Predictor(model).compiled
    with pytest.raises(FitError, match="cannot be exported"):
        Predictor(model, compiled=True)


def bent(monkeypatch, old: str, new: str) -> None:
    """The program that is compiled has something else in it."""

    def source(program):
        found = c_source(program)
        text = found.source.replace(old, new, 1)
        assert text != found.source
        return replace(found, source=text)

    monkeypatch.setattr(predictor, "c_source", source)


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize(
    ("old", "new"),
    [("hil_scale[6] = {", "hil_scale[6] = {1.0001 * "), ("way * v > 0.0 ?", "way != 0.0 ?")],
)
def test_a_program_that_says_something_else_is_not_taken(old, new, model, monkeypatch) -> None:
    bent(monkeypatch, old, new)
    with pytest.raises(FitError, match="does not agree with the model"):
        Predictor(model)


@needs_compiler
def test_a_program_that_does_not_compile_is_no_reason_to_be_slow(model, monkeypatch) -> None:
    bent(monkeypatch, "hil_scale[6] = {", "hil_scale[6] = oops {")
    with pytest.raises(FitError, match="does not compile"):
        Predictor(model)


@needs_compiler
def test_a_library_that_cannot_be_loaded_is_told(model, monkeypatch) -> None:
    def compile_program(folder, *_):
        (folder / "hil.so").write_text("no library", "utf-8")
        return folder / "hil.so"

    monkeypatch.setattr(predictor, "compile_program", compile_program)
    with pytest.raises(PluginError, match="cannot load the program compiled by"):
        Predictor(model)


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("no-such-cc", "is not an executable program"),
        ("false", "does not compile"),
        ("true", "not compile"),
    ],
)
def test_a_compiler_that_is_named_has_to_work(name, match, model, monkeypatch) -> None:
    monkeypatch.setenv("CC", name)
    with pytest.raises(PluginError, match=match):
        Predictor(model)


@pytest.mark.thorough
@needs_compiler
def test_a_compiler_may_be_named_with_options(model, monkeypatch) -> None:
    monkeypatch.setenv("CC", "cc -DNEVER_SEEN='a b'")
    assert compiler()[1:] == ("-DNEVER_SEEN=a b",)
    assert Predictor(model).compiled
