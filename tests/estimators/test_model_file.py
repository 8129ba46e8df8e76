"""The format of model files and the robots in them; test_conformance.py covers every estimator."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError
from hil.dynamics import load_model
from hil.estimators import RobotEstimator, load_model_file, save_model
from hil.estimators.static_model import StaticWls
from tests.support.dynamics_arms import urdf, written
from tests.support.every_estimator import fitted, known, new, unfitted
from tests.support.synthetic_motion import LOAD, dwelling, moving, nominal


def stored(model: RobotEstimator, tmp_path: Path) -> RobotEstimator:
    return load_model_file(save_model(model, tmp_path / "model"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return save_model(fitted("rigid-wls"), tmp_path / "model")


def rewritten(folder: Path, **changes: Any) -> Path:
    document = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(document | changes))
    return folder


def test_the_document_says_what_the_model_is(folder: Path) -> None:
    document = json.loads((folder / "model.json").read_text())
    assert document["estimator"] == "rigid-wls"
    assert document["robot"]["name"] == "ur5"
    assert document["parameters"]["sign_width"] == 0.01


def test_models_are_never_overwritten(folder: Path) -> None:
    with pytest.raises(FitError, match="already contains a model"):
        save_model(fitted("rigid-wls"), folder)


def test_a_model_of_a_newer_version_is_refused(folder: Path) -> None:
    with pytest.raises(DataError, match="newer hil: format 99"):
        load_model_file(rewritten(folder, hil_model=99))


@pytest.mark.parametrize("version", [2, 10**30, 0, -1, True, "1", None, 1.0])
def test_only_the_format_there_is_is_read(folder: Path, version: object) -> None:
    with pytest.raises(DataError, match=r"/model\.json") as caught:
        load_model_file(rewritten(folder, hil_model=version))
    assert caught.value.hint


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_damaged_document_is_refused(folder: Path, text: str) -> None:
    (folder / "model.json").write_text(text)
    with pytest.raises(DataError, match=r"model\.json"):
        load_model_file(folder)


def test_a_folder_without_a_model_or_its_arrays_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="is not a model folder"):
        load_model_file(tmp_path / "empty")
    (folder / "model.safetensors").unlink()
    with pytest.raises(DataError, match=r"cannot read .*model\.safetensors") as caught:
        load_model_file(folder)
    assert caught.value.hint


@pytest.mark.parametrize("dtype", ["bfloat16", "complex64"])
def test_numbers_that_numpy_does_not_have_are_refused(folder: Path, dtype: str) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from safetensors.torch import save

    path = folder / "model.safetensors"
    tensors = {k: torch.as_tensor(v.copy()) for k, v in load(path.read_bytes()).items()}
    tensors["sigma"] = tensors["sigma"].to(getattr(torch, dtype))
    path.write_bytes(save(tensors))
    from hashlib import sha256

    rewritten(folder, arrays_sha256=sha256(path.read_bytes()).hexdigest())
    with pytest.raises(DataError, match=r"/model\.safetensors") as caught:
        load_model_file(folder)
    assert caught.value.hint


def test_a_model_of_a_urdf_carries_the_urdf_along(tmp_path: Path) -> None:
    file = written(tmp_path, urdf("ur5"))
    model = StaticWls().fit(dwelling(80), load_model(file))
    folder = save_model(model, tmp_path / "model")
    file.unlink()
    data = dwelling(10, seed=4)
    assert np.array_equal(load_model_file(folder).predict(data).effort, model.predict(data).effort)


def test_a_model_of_a_urdf_that_was_changed_since_is_not_stored(tmp_path: Path) -> None:
    file = written(tmp_path, urdf("ur5"))
    model = StaticWls().fit(dwelling(120), load_model(file))
    written(tmp_path, urdf("ur10"))
    with pytest.raises(FitError, match=r"loading .* again gives a different robot model"):
        save_model(model, tmp_path / "model")


def test_a_model_of_a_robot_on_the_wall_comes_back_on_the_wall(tmp_path: Path) -> None:
    wall = load_model("ur5", gravity=(0.0, 9.81, 0.0))
    model = StaticWls().fit(dwelling(120, stiction_nm=1.0), wall)
    again = stored(model, tmp_path)
    test = replace(dwelling(10, seed=4, load=LOAD), gravity=(0.0, 9.81, 0.0))
    assert again.robot_.gravity_vector.tolist() == [0.0, 9.81, 0.0]
    assert np.array_equal(again.predict(test).effort, model.predict(test).effort)


def test_a_model_knows_the_loads_it_was_fitted_with(tmp_path: Path) -> None:
    mounted = Payload(2.0, (0.02, -0.03, 0.06), (0.004, 0.005, 0.003, 0.0, 0.0, 0.0))
    model = unfitted("rigid-wls").fit(moving(1, 2, load=mounted), nominal())
    training = stored(model, tmp_path).training_
    assert training is not None
    assert training.payloads == (mounted,)


@pytest.mark.thorough
def test_a_whole_number_that_a_file_has_with_a_point_is_read(tmp_path: Path) -> None:
    folder = save_model(fitted("lagrangian"), tmp_path / "model")
    parameters = json.loads((folder / "model.json").read_text())["parameters"]
    parameters["training"]["epochs"] = 1.0
    again = load_model_file(rewritten(folder, parameters=parameters))
    assert len(again.predict(new("lagrangian")).effort) == len(new("lagrangian"))
    assert again.samples_ <= len(known("lagrangian"))


def test_a_file_says_what_its_standard_errors_take_for_granted(folder: Path) -> None:
    said = json.loads((folder / "model.json").read_text("utf-8"))["fitted"]["std_error"]
    assert "given exact drive gains" in "given " + said["given"]
    assert "noise in the regressor" in said["leaves_out"]
    assert said["correlated_samples"] == pytest.approx([1.0] * 6, abs=0.3)
    again = load_model_file(folder)
    assert again.correlated_samples_.tolist() == said["correlated_samples"]
