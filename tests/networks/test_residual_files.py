"""A residual network on disk and as a stream."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.residual_models import model, unknown
from tests.support.synthetic_motion import LOAD

pytest.importorskip("torch", reason="torch is not installed")

from hil.core import json_value
from hil.core.errors import DataError
from hil.estimators.base import load_model_file, prepared
from hil.estimators.model_file import save_model


def test_a_stored_model_predicts_the_same(tmp_path: Path) -> None:
    loaded = load_model_file(save_model(model(), tmp_path / "model"))
    ours, theirs = model().predict(unknown()), loaded.predict(unknown())
    assert np.array_equal(ours.effort, theirs.effort)
    assert np.array_equal(ours.std, theirs.std)
    assert loaded.get_params()["base"] == model().get_params()["base"]
    assert loaded.notes_ == model().notes_


@pytest.mark.parametrize("load", [None, LOAD])
def test_a_stream_says_what_the_series_pass_says(load) -> None:
    one = unknown().take([0])
    if load is not None:
        one = replace(one, conditions=(replace(one.conditions[0], payload=load),))
    data = prepared(one, model().filters_)
    whole = model().predict(data).effort
    stream = model().stream(load)
    motion = zip(data["q_f"], data["qd_f"], data["qdd_f"], strict=True)
    stepped = np.array([stream.step(*sample) for sample in motion])
    assert stepped == pytest.approx(whole, abs=1e-5)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("base", "estimator"), "rigid-hysteresis"),
        (("base", "fitted", "joint_names"), ["a"] * 6),
        (("networks",), 1000),
        (("networks",), 1),
        (("networks",), 0),
        (("residual", "kernel"), 4),
        (("selection", 0, "kept"), None),
        (("curves",), {}),
    ],
)
def test_garbled_documents_are_refused(tmp_path: Path, keys, value) -> None:
    folder = save_model(model(), tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    at = document["fitted"]
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = (not at[keys[-1]]) if value is None else value
    (folder / "model.json").write_text(json.dumps(document))
    with pytest.raises(DataError):
        load_model_file(folder)


@pytest.mark.parametrize("rate_hz", [0.0, -100.0, np.inf])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    arrays = model().fitted_arrays() | {"network2.rate_hz": np.array([rate_hz])}
    fresh = type(model())(**model().get_params())
    fresh.robot_ = model().robot_
    with pytest.raises((ValueError, DataError)):
        fresh.restore(arrays, json_value(model().fitted_facts()))


@pytest.mark.parametrize(
    "name", ["base.coefficients", "network1.weights.enter", "bands_half_widths", "limit"]
)
@pytest.mark.parametrize("damage", ["gone", "nan", "cut"])
def test_damaged_arrays_are_refused(name: str, damage: str) -> None:
    arrays, facts = model().fitted_arrays(), model().fitted_facts()
    fresh = type(model())(**model().get_params())
    fresh.robot_ = model().robot_
    broken = dict(arrays)
    if damage == "gone":
        del broken[name]
    else:
        broken[name] = np.full_like(arrays[name], np.nan) if damage == "nan" else arrays[name][:1]
    with pytest.raises((KeyError, ValueError, DataError)):
        fresh.restore(broken, json_value(facts))
