"""Models on disk: what comes back predicts bit for bit the same, what is damaged is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import DataError, FitError, PluginError, SpecError
from hil.estimators import estimator, load_model_file, save_model
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from tests.support.synthetic_motion import LOAD, dwelling, moving, nominal


@pytest.fixture(scope="module")
def rigid():
    return RigidWls(sign_width=0.02, filters={"effort": 0.3}).fit(
        moving(1, 2, noise_a=0.02), nominal()
    )


def stored(model, tmp_path):
    return load_model_file(save_model(model, tmp_path / "model"))


def test_stored_model_predicts_bit_for_bit_the_same(rigid, tmp_path) -> None:
    again = stored(rigid, tmp_path)
    test = moving(9, load=LOAD)
    ours, theirs = rigid.predict(test), again.predict(test)
    assert np.array_equal(ours.effort, theirs.effort)
    assert np.array_equal(ours.std, theirs.std)
    assert again.get_params() == rigid.get_params()
    assert again.parameter_names_ == rigid.parameter_names_


@pytest.mark.parametrize("form", ["shared", "paper"])
def test_stored_static_model_predicts_bit_for_bit_the_same(form, tmp_path) -> None:
    model = StaticWls(form=form).fit(dwelling(80), nominal())
    test = dwelling(10, seed=4)
    assert np.array_equal(model.predict(test).effort, stored(model, tmp_path).predict(test).effort)


def test_model_folder_holds_json_and_safetensors_only(rigid, tmp_path) -> None:
    folder = save_model(rigid, tmp_path / "model")
    assert {f.name for f in folder.iterdir()} == {"model.json", "model.safetensors"}
    document = json.loads((folder / "model.json").read_text())
    assert document["estimator"] == "rigid-wls"
    assert document["robot"]["name"] == "ur5"
    assert document["parameters"]["sign_width"] == 0.02


def test_models_are_never_overwritten(rigid, tmp_path) -> None:
    save_model(rigid, tmp_path)
    with pytest.raises(FitError, match="holds a model already"):
        save_model(rigid, tmp_path)


def test_model_of_a_newer_version_is_refused(rigid, tmp_path) -> None:
    folder = save_model(rigid, tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(document | {"hil_model": 99}))
    with pytest.raises(DataError, match="newer hil: format 99"):
        load_model_file(folder)


def test_damaged_arrays_are_refused(rigid, tmp_path) -> None:
    folder = save_model(rigid, tmp_path / "model")
    content = bytearray((folder / "model.safetensors").read_bytes())
    content[-1] ^= 1
    (folder / "model.safetensors").write_bytes(content)
    with pytest.raises(DataError, match="damaged"):
        load_model_file(folder)


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_damaged_document_is_refused(rigid, tmp_path, text) -> None:
    folder = save_model(rigid, tmp_path / "model")
    (folder / "model.json").write_text(text)
    with pytest.raises(DataError, match=r"model\.json"):
        load_model_file(folder)


def test_folder_without_a_model_is_refused(tmp_path) -> None:
    with pytest.raises(DataError, match="no model folder"):
        load_model_file(tmp_path)


def test_model_of_a_urdf_carries_the_urdf_along(tmp_path) -> None:
    joints = "".join(
        f'<link name="l{i + 1}"><inertial><mass value="1"/><origin xyz="0.1 0.02 0"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
        '<origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="9" velocity="1"/></joint>'
        for i in range(2)
    )
    urdf = tmp_path / "two.urdf"
    urdf.write_text(f'<robot name="two"><link name="l0"/>{joints}</robot>')
    from dataclasses import replace

    from hil.dynamics import load_model

    data = dwelling(40)
    two = {name: v if name == "t" else v[:, :2] for name, v in data.columns.items()}
    data = replace(
        data, columns=two, joint_names=("j0", "j1"), drive_gains=data.drive_gains[:2], robot="two"
    )
    model = StaticWls().fit(data, load_model(urdf))
    folder = save_model(model, tmp_path / "model")
    urdf.unlink()
    assert np.array_equal(load_model_file(folder).predict(data).effort, model.predict(data).effort)


def test_model_of_a_robot_on_the_wall_comes_back_on_the_wall(tmp_path) -> None:
    from hil.dynamics import load_model

    wall = load_model("ur5", gravity=(0.0, 9.81, 0.0))
    model = StaticWls().fit(dwelling(120, stiction_nm=1.0), wall)
    again = stored(model, tmp_path)
    test = replace(dwelling(10, seed=4, load=LOAD), gravity=(0.0, 9.81, 0.0))
    assert again.robot_.gravity_vector.tolist() == [0.0, 9.81, 0.0]
    assert np.array_equal(again.predict(test).effort, model.predict(test).effort)


def test_model_of_a_urdf_that_was_changed_since_is_not_stored(tmp_path) -> None:
    from hil.dynamics import load_model
    from tests.support.dynamics_arms import urdf, written

    file = written(tmp_path, urdf("ur5"))
    model = StaticWls().fit(dwelling(120), load_model(file))
    written(tmp_path, urdf("ur10"))
    with pytest.raises(FitError, match="leads to when it is loaded again"):
        save_model(model, tmp_path / "model")


def test_unfitted_model_is_not_stored(tmp_path) -> None:
    with pytest.raises(FitError, match="not fitted"):
        save_model(RigidWls(), tmp_path)


def test_estimators_are_found_by_name_with_their_parameters() -> None:
    made = estimator("rigid-wls", sign_width=0.005)
    assert isinstance(made, RigidWls)
    assert made.get_params()["sign_width"] == 0.005


def test_unknown_estimator_comes_with_a_guess() -> None:
    with pytest.raises(PluginError, match="rigid-wsl") as caught:
        estimator("rigid-wsl")
    assert "'rigid-wls'" in caught.value.hint


def test_unknown_parameter_names_those_there_are() -> None:
    with pytest.raises(
        SpecError, match=r"no parameter 'sign_widht' \(it has sign_width, "
    ) as caught:
        estimator("rigid-wls", sign_widht=1)
    assert "'sign_width'" in caught.value.hint


@pytest.mark.parametrize("filters", [{"velocty": 0.1}, {"velocity": -1}, 3])
def test_filter_settings_that_cannot_be_are_refused(filters) -> None:
    with pytest.raises(SpecError, match="rigid-wls"):
        estimator("rigid-wls", filters=filters)


def test_changed_parameters_are_checked() -> None:
    model = StaticWls()
    assert model.set_params(form="paper").form == "paper"
    with pytest.raises(SpecError, match="no parameter"):
        model.set_params(shape=1)
