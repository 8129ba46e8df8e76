"""The estimator `lagrangian`: what it learns from, what it predicts, what its file refuses."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core import json_document
from hil.core.errors import DataError, PluginError, SpecError
from hil.data.splits import TEST, TRAINING, VALIDATION, with_part
from hil.estimators import estimator, load_model_file, save_model
from hil.estimators.base import HONEST, prepared
from hil.estimators.model_file import model_files
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import LOAD, moving, nominal

torch = pytest.importorskip("torch", reason="torch is not installed")

QUICK = {"epochs": 3, "batch_size": 300, "device": "cpu"}
SMALL = {"network": {"hidden": [12]}, "training": QUICK}


def made(**params):
    return estimator("lagrangian", **{**SMALL, **params})


@pytest.fixture(scope="module")
def fitted():
    return made().fit(moving(1, 2, 3, noise_a=0.02), nominal())


def errors(model, data):
    return np.sqrt(np.mean((data["effort"] - model.predict(data).effort) ** 2, axis=0))


def test_components_add_up_to_the_effort(fitted) -> None:
    found = fitted.predict(moving(9, load=LOAD))
    assert set(found.components) == {"inertia", "coriolis", "gravity", "friction", "payload"}
    assert np.allclose(sum(found.components.values()), found.effort, atol=1e-9)
    assert found.valid.all()


@pytest.mark.thorough
def test_it_learns_what_an_arm_with_friction_does() -> None:
    part = np.tile([TRAINING, TRAINING, VALIDATION, TEST], 150)
    data = with_part(moving(1), part)
    steps = {"epochs": 50, "batch_size": 16, "learning_rate": 1e-2, "loss": "huber"}
    model = made(network={"hidden": [32, 32]}, training={**QUICK, **steps}).fit(data, nominal())
    left = (data["effort"] - model.predict(data).effort)[part == TEST]
    assert np.all(np.std(left, axis=0) < 0.2 * np.std(data["effort"], axis=0))


def test_a_declared_load_is_added_as_the_robot_model_has_it(fitted) -> None:
    bare, loaded = moving(9), moving(9, load=LOAD)
    motion = (bare["q_f"], bare["qd_f"], bare["qdd_f"])
    added = fitted.predict(loaded).effort - fitted.predict(bare).effort
    assert np.allclose(added * fitted.torque_scale_, nominal().payload_effort(LOAD, *motion))


def test_a_declared_load_is_taken_off_before_the_network_learns(fitted) -> None:
    loaded = made().fit(moving(1, 2, 3, noise_a=0.02, load=LOAD), nominal())
    assert np.allclose(loaded.torque_std_, fitted.torque_std_, rtol=1e-6)
    assert errors(loaded, moving(9, load=LOAD)) == pytest.approx(
        errors(loaded, moving(9)), rel=1e-3
    )


def test_equal_seeds_give_equal_models_and_others_give_others(fitted) -> None:
    data, test = moving(1, 2, 3, noise_a=0.02), moving(9)
    expected = fitted.predict(test).effort
    assert np.array_equal(made().fit(data, nominal()).predict(test).effort, expected)
    assert not np.allclose(made(seed=1).fit(data, nominal()).predict(test).effort, expected)


def test_scales_are_those_of_the_rows_that_are_learned_from() -> None:
    data = moving(1, 2, 3)
    part = np.repeat([TRAINING, TRAINING, VALIDATION], 600)
    spoilt = data["effort_f"] * np.where(part == TRAINING, 1.0, 50.0)[:, None]
    told = with_part(data, part)
    expected = np.std(data["effort_f"][:1200] * data.drive_gains, axis=0)
    for one in (told, told.with_columns(effort_f=spoilt)):
        assert np.allclose(made().fit(one, nominal()).torque_std_, expected)


def test_judged_rows_change_nothing() -> None:
    part = np.random.default_rng(0).choice([TRAINING, VALIDATION, TEST], 1800, p=(0.6, 0.2, 0.2))
    data = with_part(moving(1, 2, 3), part)
    spoilt = data["effort_f"] + np.where(part == TEST, 1e3, 0.0)[:, None]
    ours, theirs = (
        made(direction="dahl").fit(one, nominal())
        for one in (data, data.with_columns(effort_f=spoilt))
    )
    assert np.array_equal(ours.length_, theirs.length_)
    for name, weight in ours.weights_.items():
        assert np.array_equal(weight, theirs.weights_[name]), name


@pytest.mark.parametrize(
    ("part", "protocol"),
    [
        (np.repeat([TRAINING, VALIDATION, TEST], 600), HONEST),
        (np.tile([TRAINING, VALIDATION, TEST], 600), "paper: rows of the same motions"),
    ],
    ids=["whole motions", "by sample"],
)
def test_a_split_by_sample_is_told_in_the_protocol(part, protocol, tmp_path) -> None:
    model = made().fit(with_part(moving(1, 2, 3), part), nominal())
    assert model.protocol.startswith(protocol)
    assert load_model_file(save_model(model, tmp_path / "model")).protocol == model.protocol


def test_mass_matrix_is_that_of_the_inertia_torque(fitted) -> None:
    data = moving(9, samples=50)
    M = fitted.mass_matrix(data["q_f"])
    torque = np.einsum("kij,kj->ki", M, data["qdd_f"])
    inertia = fitted.predict(data).components["inertia"] * fitted.torque_scale_
    assert np.allclose(torque, inertia, atol=1e-4)
    assert np.all(np.linalg.eigvalsh(M) > 0)


def test_a_stream_says_what_a_prediction_says(fitted) -> None:
    data = moving(9, load=LOAD, samples=40)
    stream = fitted.stream(LOAD)
    motion = zip(data["q_f"], data["qd_f"], data["qdd_f"], strict=True)
    single = np.array([stream.step(*sample) for sample in motion])
    assert np.allclose(single, fitted.predict(data).effort, atol=1e-5)


@pytest.mark.thorough
def test_a_stream_carries_dahls_state_along() -> None:
    data = remembering(1, 2, 3)
    model = made(direction="dahl").fit(data, nominal())
    test = remembering(4)
    stream, batch = model.stream(), model.predict(test).effort
    rows = prepared(test, model.filters_)
    motion = zip(rows["q_f"], rows["qd_f"], rows["qdd_f"], strict=True)
    single = np.array([stream.step(*sample) for sample in motion])
    # Steps from positions and from velocities differ a little where a joint turns.
    assert np.median(np.abs(single - batch)) < 0.01 * np.mean(np.std(batch, axis=0))
    assert np.mean(np.abs(single - batch)) < 0.03 * np.mean(np.std(batch, axis=0))


def test_stored_model_predicts_bit_for_bit_the_same(fitted, tmp_path) -> None:
    again = load_model_file(save_model(fitted, tmp_path / "model"))
    test = moving(9, load=LOAD)
    assert np.array_equal(again.predict(test).effort, fitted.predict(test).effort)
    assert again.get_params() == fitted.get_params()
    assert again.curves_.to_dict() == fitted.curves_.to_dict()


def test_a_model_file_tells_friction_and_learning_curves(fitted, tmp_path) -> None:
    folder = save_model(fitted, tmp_path / "model")
    facts = json.loads((folder / "model.json").read_text())["fitted"]
    assert set(facts["friction"]) == {"f_s", "f_c", "f_v", "v_s", "delta_s", "alpha", "offset"}
    assert len(facts["curves"]["validation"]) == len(fitted.curves_)


def damaged(folder, change):
    """Store a model whose fitted facts went through `change`."""
    path = folder / "model.json"
    document = json.loads(path.read_text())
    change(document["fitted"])
    path.write_bytes(json_document(document))
    return folder


@pytest.mark.parametrize(
    "change",
    [
        lambda facts: facts.pop("design"),
        lambda facts: facts["design"].update(kind="magnetic"),
        lambda facts: facts["design"]["network"].update(hidden=[13]),
        lambda facts: facts["design"]["network"].update(activation=["softplus"]),
        lambda facts: facts["design"].update(friction=None),
        lambda facts: facts["curves"].update(loss="high"),
        lambda facts: facts.update(filters={"velocity": -1}),
    ],
)
def test_damaged_facts_are_refused(change, fitted, tmp_path) -> None:
    folder = damaged(save_model(fitted, tmp_path / "model"), change)
    with pytest.raises(DataError, match=r"model\.json lacks or garbles"):
        load_model_file(folder)


@pytest.mark.parametrize("damage", ["missing", "shape", "nan", "more", "scale"])
def test_damaged_weights_are_refused(damage, fitted, tmp_path) -> None:
    broken = made()
    broken.__dict__.update(fitted.__dict__)
    weights = dict(fitted.weights_)
    first = next(name for name in weights if name.endswith("weight"))
    if damage == "missing":
        del weights[first]
    elif damage == "shape":
        weights[first] = weights[first][:-1]
    elif damage == "nan":
        weights[first] = weights[first] * np.nan
    elif damage == "more":
        weights["more"] = weights[first]
    else:
        broken.torque_std_ = fitted.torque_std_ * 0.0
    broken.weights_ = weights
    folder = tmp_path / "model"
    broken.fitted_facts = fitted.fitted_facts
    folder.mkdir()
    for name, content in model_files(broken).items():
        (folder / name).write_bytes(content)
    with pytest.raises(DataError, match=r"model\.json lacks or garbles"):
        load_model_file(folder)


def test_without_torch_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(PluginError) as caught:
        made().fit(moving(1, 2), nominal())
    assert "hil[learn]" in caught.value.hint


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"friction": "stribek"}, "friction is 'stribek'"),
        ({"network": {"hiden": [3]}}, "network has no parameter 'hiden'"),
        ({"training": {"epochs": 0}}, "training.epochs"),
        ({"protocol": "theirs"}, "protocol is 'theirs'"),
        ({"loops": 0}, "loops is 0"),
        ({"sign_width": -1.0}, "sign_width"),
        ({"validation_share": 2}, "validation_share is 2"),
        ({"protocol": "paper", "direction": "dahl"}, "protocol is 'paper'.* hard sign"),
        ({"friction_settings": {"unt": 0.2}}, "friction_settings: .* no parameter 'unt'"),
        ({"friction_settings": {"unit": 0}}, "friction_settings: unit is 0"),
        ({"friction_settings": {"speed_bounds": [0.1, 0.2]}}, "settings: start_speed is 0.08"),
        ({"friction_settings": ["offset"]}, r"friction_settings is \['offset'\]"),
        ({"friction_settings": {"sign": "hard"}, "direction": "dahl"}, "settings has a hard sign"),
    ],
)
def test_parameters_are_checked_before_anything_is_computed(params, told) -> None:
    with pytest.raises(SpecError, match=told):
        made(**params)


def test_protocol_paper_takes_the_papers_settings(fitted) -> None:
    model = made(protocol="paper", training={"epochs": 1, "batch_size": 300, "device": "cpu"})
    assert model.get_params()["protocol"] == "paper"
    model.fit(moving(1, 2, 3), nominal())
    design = model.design_
    assert (design.network.activation, design.network.gravity) == ("relu", "head")
    assert (design.friction.sign, design.friction.offset) == ("hard", False)
    assert model.protocol == HONEST
    assert fitted.design_.network.activation != "relu"


@pytest.mark.thorough
def test_settings_of_the_friction_are_laid_over_those_of_the_protocol(tmp_path) -> None:
    changed = {"offset": False, "speed_bounds": [0.01, 0.5], "rest_speed": 0.2}
    model = made(friction_settings=changed).fit(moving(1, 2, 3), nominal())
    assert set(model.intrinsic_) == {"f_s", "f_c", "f_v", "v_s", "delta_s", "alpha"}
    again = load_model_file(save_model(model, tmp_path / "model"))
    assert again.get_params()["friction_settings"] == changed
    friction = again.design_.friction
    assert (friction.speed_bounds, friction.rest_speed) == ((0.01, 0.5), 0.2)
    usual = made(sign_width=0.03)._settings()[0].friction
    assert (usual.offset, usual.rest_speed) == (True, 0.03)
    paper = made(protocol="paper", friction_settings={"offset": True})._settings()[0].friction
    assert (paper.sign, paper.scaled, paper.offset) == ("hard", False, True)


def test_parameters_can_be_changed_one_by_one() -> None:
    model = made().set_params(protocol="paper", friction="coulomb")
    assert (model.get_params()["protocol"], model.friction) == ("paper", "coulomb")
    with pytest.raises(SpecError):
        model.set_params(friction="none", protocol="other")
    assert model.friction == "coulomb"


@pytest.mark.thorough
@pytest.mark.parametrize("friction", ["none", "coulomb", "dissipative", "unconstrained"])
def test_every_friction_fits_and_comes_back(friction, tmp_path) -> None:
    model = made(friction=friction).fit(moving(1, 2, 3), nominal())
    again = load_model_file(save_model(model, tmp_path / "model"))
    test = moving(9)
    assert np.array_equal(again.predict(test).effort, model.predict(test).effort)
    assert np.any(model.predict(test).components["friction"]) == (friction != "none")


@pytest.mark.thorough
@pytest.mark.parametrize("settings_of", ["ours", "paper"])
def test_dissipative_friction_has_the_sign_width_of_the_estimator(settings_of, tmp_path) -> None:
    model = made(friction="dissipative", sign_width=0.04, protocol=settings_of)
    model.fit(moving(1, 2, 3), nominal())
    again = load_model_file(save_model(model, tmp_path / "model"))
    assert (model.design_.friction.rest_speed, again.design_.friction.rest_speed) == (0.04, 0.04)


def test_an_arm_without_a_load_is_the_same_as_a_load_of_nothing(fitted) -> None:
    data = moving(9)
    empty = replace(data, conditions=tuple(replace(c, payload=Payload()) for c in data.conditions))
    assert np.array_equal(fitted.predict(empty).effort, fitted.predict(data).effort)
