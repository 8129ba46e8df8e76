"""Models in a loop: compiled or not, the same numbers; nothing allocated when compiled."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from synthetic_memory import remembering
from synthetic_motion import LOAD, nominal

from hil.deploy import compiled
from hil.deploy.export.c_build import compiler
from hil.deploy.export.golden import motion
from hil.deploy.predictor import Predictor
from hil.errors import DataError, FitError, PluginError
from hil.identify import estimator
from hil.identify.base import prepared
from hil.payload import Payload

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
Q, QD, QDD = motion(nominal(), 200, 250.0)


@pytest.fixture(scope="module")
def model():
    return estimator("rigid-hysteresis", consistent=False).fit(remembering(1, 2, 3), nominal())


def said(predictor: Predictor) -> np.ndarray:
    return np.array([predictor.step(*one).copy() for one in zip(Q, QD, QDD, strict=True)])


@needs_compiler
@pytest.mark.parametrize("load", [None, LOAD])
def test_compiled_or_not_it_says_the_same(load, model) -> None:
    fast, slow = (Predictor(model, load, compiled=how) for how in (True, False))
    assert (fast.compiled, slow.compiled) == (True, False)
    assert np.allclose(said(fast), said(slow), rtol=0, atol=1e-10)


@needs_compiler
def test_a_reset_forgets_the_way_and_keeps_the_load(model) -> None:
    predictor = Predictor(model, LOAD)
    first = said(predictor)
    assert not np.allclose(said(predictor), first, rtol=0, atol=1e-6)
    predictor.reset()
    assert np.array_equal(said(predictor), first)


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


@needs_compiler
@pytest.mark.parametrize("bad", [np.full(6, np.nan), np.full(6, np.inf), np.full(6, 1e7)])
def test_what_cannot_be_is_refused_and_not_remembered(bad, model) -> None:
    predictor, twin = Predictor(model), Predictor(model)
    for k in range(20):
        with pytest.raises(DataError, match="not finite"):
            predictor.step(bad, QD[k], QDD[k])
        assert np.array_equal(predictor.step(Q[k], QD[k], QDD[k]), twin.step(Q[k], QD[k], QDD[k]))


@needs_compiler
@pytest.mark.parametrize("bad", [np.zeros(5), "abc", np.zeros((2, 6))])
def test_samples_of_another_width_are_refused(bad, model) -> None:
    with pytest.raises(DataError, match="6 joints"):
        Predictor(model).step(bad, QD[0], QDD[0])


@needs_compiler
def test_a_load_that_is_none_is_refused(model) -> None:
    load = Payload(mass=1.0)
    object.__setattr__(load, "mass", float("nan"))
    with pytest.raises(DataError, match="is no load"):
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
        raise FitError("cannot be exported as a program")

    monkeypatch.setattr(compiled, "program_of", refused)
    assert not Predictor(model).compiled
    with pytest.raises(FitError, match="cannot be exported"):
        Predictor(model, compiled=True)
