"""The estimator `lagrangian`: what it learns from, what it predicts, its trials and its file."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from hil.core import json_document
from hil.core.errors import DataError, FitError, PluginError
from hil.data.splits import TEST, TRAINING, VALIDATION, with_part
from hil.estimators import estimator, load_model_file, save_model
from hil.estimators.base import HONEST, prepared
from hil.estimators.model_file import model_files
from hil.networks import lagrangian_settings
from tests.support.lagrangian_models import lagrangian
from tests.support.residual_models import model
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import LOAD, moving, nominal

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks import lagrangian as trainings  # noqa: E402
from hil.networks.lagrangian_data import smooth_sign  # noqa: E402
from hil.report import model_figures as figures  # noqa: E402
from hil.report.predictions import predict_with  # noqa: E402

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
    with pytest.raises(DataError, match=r"model\.json is damaged; missing or invalid"):
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
    with pytest.raises(DataError, match=r"model\.json is damaged; missing or invalid"):
        load_model_file(folder)


def test_without_torch_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(PluginError) as caught:
        made().fit(moving(1, 2), nominal())
    assert "hil[learn]" in caught.value.hint


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


@pytest.mark.thorough
@pytest.mark.parametrize("settings_of", ["ours", "paper"])
def test_dissipative_friction_has_the_sign_width_of_the_estimator(settings_of, tmp_path) -> None:
    model = made(friction="dissipative", sign_width=0.04, protocol=settings_of)
    model.fit(moving(1, 2, 3), nominal())
    again = load_model_file(save_model(model, tmp_path / "model"))
    assert (model.design_.friction.rest_speed, again.design_.friction.rest_speed) == (0.04, 0.04)


# Trainings of which the one that validates best is kept

FAST, SLOW = {"friction": 1.0}, {"friction": 0.2}


def rates(friction, protocol="ours", **changed):
    training = lagrangian_settings.training_settings(protocol, 3, 0, changed)
    return [one.group_rates for one in lagrangian_settings.trials(friction, protocol, training)]


def dissipative(**training):
    quick = {"epochs": 3, "batch_size": 300, "device": "cpu", **training}
    return estimator(
        "lagrangian", friction="dissipative", network={"hidden": [12]}, training=quick
    )  # fmt: skip


def test_a_dissipative_network_is_tried_with_a_slow_rate_as_well() -> None:
    assert rates("dissipative") == [{}, SLOW]
    assert rates("dissipative", group_rates={"dynamics": 0.5}) == [
        {"dynamics": 0.5}, {"dynamics": 0.5, **SLOW},
    ]  # fmt: skip


def test_given_rates_and_those_of_the_paper_are_tried_alone() -> None:
    assert rates("dissipative", group_rates=FAST) == [FAST]
    assert rates("dissipative", "paper") == [{}]
    assert rates("stribeck") == [{}]


@pytest.mark.thorough
@pytest.mark.parametrize("order", [(1.0, 0.2), (0.2, 1.0)])
def test_the_trial_that_validates_best_is_kept(order, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(lagrangian_settings.FRICTION_RATES, "dissipative", order)
    data, robot = moving(1, 2, 3), nominal()
    both, told = dissipative(), []
    both.checkpoints_, both.watch_ = tmp_path, told.append
    both.fit(data, robot)
    alone = [dissipative(group_rates=rate).fit(data, robot) for rate in (FAST, SLOW)]
    best = min(alone, key=lambda one: one.curves_.best)
    assert alone[0].curves_.best != alone[1].curves_.best
    assert both.curves_.best == best.curves_.best
    assert all(np.array_equal(both.weights_[name], best.weights_[name]) for name in best.weights_)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["trial-1", "trial-2"]
    assert {one.stage.split(":")[0] for one in told} == {"trial 1 of 2", "trial 2 of 2"}


def test_a_model_file_tells_of_every_trial(tmp_path) -> None:
    model = dissipative().fit(moving(1, 2, 3), nominal())
    first, second = load_model_file(save_model(model, tmp_path / "model")).notes_
    assert first.startswith("trial 1 of 2, friction at 1 of the learning rate: validation error ")
    assert second.startswith("trial 2 of 2, friction at 0.2 of the learning rate: validation")


@pytest.mark.parametrize("diverging", [1, 2])
def test_a_trial_that_diverges_loses(diverging, monkeypatch) -> None:
    trained, calls = trainings._trained, []

    def spoiled(*args):
        calls.append(args)
        if len(calls) == diverging:
            raise FitError("training diverged")
        return trained(*args)

    monkeypatch.setattr(trainings, "_trained", spoiled)
    model = dissipative().fit(moving(1, 2, 3), nominal())
    assert len(calls) == 2
    assert "training diverged" in model.notes_[diverging - 1]


def test_a_fit_fails_when_every_trial_diverges(monkeypatch) -> None:
    def spoiled(*args):
        raise FitError("training diverged")

    monkeypatch.setattr(trainings, "_trained", spoiled)
    with pytest.raises(FitError, match="diverged"):
        dissipative().fit(moving(1, 2, 3), nominal())


# Friction over velocity: a curve where it is one, the same that is predicted

CURVES = {
    "stribeck": ("coulomb", "static", "viscous", "offset"),
    "stribeck hard": ("coulomb", "static", "viscous", "offset"),
    "coulomb": ("coulomb", "viscous", "offset"),
    "paper": ("coulomb", "static", "viscous"),
}


@pytest.mark.parametrize("case", CURVES)
def test_the_curve_is_the_friction_that_is_predicted(case: str) -> None:
    fitted, data = lagrangian(case), moving(9)
    found, qd = fitted.predict(data), data["qd_f"]
    curve = fitted.friction_curve(qd)
    told = found.components["friction"] * fitted.torque_scale_
    assert curve.torque == pytest.approx(told, abs=1e-4)
    assert curve.terms == CURVES[case]
    assert np.isnan(curve.std_error).all()


@pytest.mark.parametrize(
    ("case", "width"), [("stribeck double", 0.01), ("coulomb", 0.0), ("paper double", 0.0)]
)
def test_what_it_has_beyond_its_dry_part_is_viscous(case: str, width: float) -> None:
    fitted = lagrangian(case)
    f_v, alpha = fitted.intrinsic_["f_v"], fitted.intrinsic_.get("alpha", np.ones(6))
    qd = np.array([[-0.8], [0.0], [0.005], [0.5]]) * np.ones(6)
    curve = fitted.friction_curve(qd)
    sign = smooth_sign(qd, width)
    assert curve.torque - curve.dry == pytest.approx(sign * f_v * np.abs(qd) ** alpha)
    assert np.all(f_v != 0.0)


@pytest.mark.parametrize("case", ["stribeck dahl", "coulomb dahl", "dissipative", "unconstrained"])
def test_memory_and_learned_friction_are_no_curve(case: str) -> None:
    assert lagrangian(case).friction_curve(np.zeros((3, 6))) is None


def test_it_is_drawn_as_a_curve_without_a_band() -> None:
    motion = predict_with(lagrangian("stribeck"), moving(9)).friction.in_motion
    names = [curve.name for curve in figures.friction_in_motion_curves(motion, 0)]
    assert names[1:] == ["without its viscous part", "friction of the model"]


@pytest.mark.thorough
def test_of_physics_whose_networks_were_all_dropped_it_is_that_of_the_physics() -> None:
    kept, qd = model(), np.linspace(-1.0, 1.0, 5)[:, None] * np.ones(6)
    assert kept.friction_curve(qd) is None
    dropped = type(kept)()
    dropped.__dict__.update(kept.__dict__)
    none = np.zeros_like(kept.correction_.kept)
    dropped.correction_ = replace(kept.correction_, kept=none)
    assert np.array_equal(dropped.friction_curve(qd).torque, kept.base_.friction_curve(qd).torque)
    assert predict_with(dropped, moving(11)).friction.in_motion.curve is not None
    drawn = predict_with(kept, moving(11)).friction.in_motion
    assert drawn.curve is None
    assert drawn.learned
