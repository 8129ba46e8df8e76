"""The default dynamic estimator on a UR5 whose friction remembers, simulated sample by sample."""

import json
from hashlib import sha256

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from hil.core.errors import DataError
from hil.data.filters import filter_columns, prepare
from hil.dynamics.inertial import is_consistent
from hil.estimators import estimator, load_model_file
from tests.support.synthetic_memory import dahl_loop, remembering
from tests.support.synthetic_motion import GAINS, LOAD, nominal, plant

NOISE_A = 0.02
GROUPS = ("core", "load", "speed p", "memory 30")


def made(**params):
    """One without choices, quickly."""
    fast = {"friction": GROUPS, "fit_shapes": False, "consistent": False}
    return estimator("rigid-hysteresis", **(fast | params))


def rms(model, test):
    return np.sqrt(np.mean((model.predict(test).effort - test["effort"]) ** 2, axis=0))


@pytest.fixture(scope="module")
def train():
    return remembering(1, 2, 3, noise_a=NOISE_A)


@pytest.fixture(scope="module")
def held_out():
    return remembering(9, noise_a=0.0)


@pytest.fixture(scope="module")
def fitted(train):
    return estimator("rigid-hysteresis").fit(train, nominal())


@pytest.fixture(scope="module")
def quick(train):
    return made(fit_shapes=True).fit(train, nominal())


@pytest.mark.thorough
def test_a_new_trajectory_is_predicted_near_the_noise(fitted, train, held_out) -> None:
    wls = rms(estimator("rigid-wls").fit(train, nominal()), held_out)
    ours = rms(fitted, held_out)
    assert np.all(ours < 0.2 * wls)
    assert np.mean(ours) < 1.5 * NOISE_A


def test_a_joint_at_rest_holds_what_friction_it_stopped_with(fitted, held_out) -> None:
    still = np.all(held_out["qd"] == 0.0, axis=1)
    assert 150 < still.sum() < 250
    error = (fitted.predict(held_out).effort - held_out["effort"])[still]
    assert np.mean(np.sqrt(np.mean(error**2, axis=0))) < 2.5 * NOISE_A


def test_links_can_exist_and_mass_matrices_are_positive_definite(fitted) -> None:
    bodies, rotors = np.split(fitted.inertial_, [60])
    assert np.all(is_consistent(bodies.reshape(6, 10)))
    assert rotors.shape == (6,)
    assert np.all(rotors >= 0.0)
    assert fitted._base.combine(fitted.inertial_) == pytest.approx(fitted.rigid_, abs=1e-6)
    still, robot = np.zeros((6, 6)), nominal()
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
        at = np.tile(q, (6, 1))
        M = robot.torque(fitted.inertial_, at, still, np.eye(6))
        M = M - robot.torque(fitted.inertial_, at, still, still)
        assert pytest.approx(M.T, abs=1e-9) == M
        assert np.linalg.eigvalsh(M)[0] > 0.0


def test_components_add_up_to_the_effort(fitted) -> None:
    test = remembering(9, load=LOAD)
    prediction = fitted.predict(test)
    assert set(prediction.components) == {
        "gravity", "inertia", "friction", "ripple", "payload"
    }  # fmt: skip
    assert sum(prediction.components.values()) == pytest.approx(prediction.effort, abs=1e-12)
    assert np.all(prediction.valid)
    assert prediction.std[0] == pytest.approx(fitted.sigma_)


def by_hand(model, data):
    """Effort of a model with `GROUPS` from formulas and a loop, nothing filtered."""
    q, qd, still = data["q"], data["qd"], np.zeros_like(data["q"])
    arrays = model.fitted_arrays()
    offset, viscous, coulomb, load, power, long = arrays["friction"].reshape(6, 6).T
    length, _, p, _ = arrays["shapes"]
    Y = model._base.regressor(nominal(), q, qd, still)
    gears = np.abs((Y @ arrays["gear_rigid"]).reshape(q.shape))
    friction = dahl_loop(q, length) * (coulomb + load * gears) + offset + viscous * qd
    friction += dahl_loop(q, 30.0 * length) * long + power * np.sign(qd) * np.abs(qd) ** p
    return ((Y @ arrays["rigid"]).reshape(q.shape) + friction) / GAINS


def streamed(model, data, load=None):
    stream, still = model.stream(load), np.zeros(6)
    return np.array(
        [stream.step(q, qd, still) for q, qd in zip(data["q"], data["qd"], strict=True)]
    )


@pytest.mark.thorough
def test_stream_is_the_model_sample_by_sample_without_filters(quick, held_out) -> None:
    assert streamed(quick, held_out) == pytest.approx(by_hand(quick, held_out), abs=2e-3)


@pytest.mark.thorough
def test_prediction_is_the_stream_through_the_filter_of_the_effort(quick, held_out) -> None:
    data, still = prepare(held_out, quick.filters_), np.zeros(held_out["q"].shape)
    parts = quick.predict(data.with_columns(qdd_f=still, qd_f=data["qd"])).components
    friction = streamed(quick, held_out) - parts["gravity"] - parts["inertia"]
    error = filter_columns(friction, data, quick.filters_) - parts["friction"]
    assert np.all(np.std(error, axis=0) < 0.03 * np.std(parts["friction"], axis=0))


def test_stream_remembers_the_way_and_time_does_not_wear_it(quick) -> None:
    q, still = np.zeros(6), np.zeros(6)

    def after(way, rest):
        stream = quick.stream()
        stream.step(q, still, still)
        stream.step(q + way, np.full(6, 1e-6), still)
        return [stream.step(q + way, still, still) for _ in range(rest)][-1]

    there = after(0.05, 1)
    assert np.array_equal(after(0.05, 200), there)
    assert np.all(there > after(-0.05, 1) + 0.05)


def test_stream_under_a_load_carries_it(quick) -> None:
    q, still = np.full(6, 0.7), np.zeros(6)
    more = quick.stream(LOAD).step(q, still, still) - quick.stream().step(q, still, still)
    loaded = plant().with_payload(LOAD).gravity(q[None]) - plant().gravity(q[None])
    assert more * GAINS == pytest.approx(loaded[0], abs=1e-9)


def test_a_declared_load_changes_friction_through_the_gears(quick) -> None:
    loaded = remembering(9, load=LOAD, noise_a=0.0)
    aware = quick.predict(loaded)
    bare = quick.predict(remembering(9, noise_a=0.0)).components["friction"]
    without = aware.effort - aware.components["friction"] + bare
    error, blind = (np.std(x - loaded["effort"], axis=0) for x in (aware.effort, without))
    assert np.all(error[1:3] < 0.9 * blind[1:3])


def test_model_file_gives_identical_predictions(fitted, held_out, tmp_path) -> None:
    again = load_model_file(fitted.save(tmp_path / "model"))
    assert np.array_equal(again.predict(held_out).effort, fitted.predict(held_out).effort)
    assert np.array_equal(again.inertial_, fitted.inertial_)
    assert again.parameter_names_ == fitted.parameter_names_
    arrays = fitted.fitted_arrays()
    assert len(again.parameter_names_) == len(arrays["rigid"]) + len(arrays["friction"])


@pytest.mark.parametrize(
    "damage",
    [
        lambda facts, arrays: facts["friction"][2].__setitem__(1, "sorcery"),
        lambda facts, arrays: facts["friction"].pop(),
        lambda facts, arrays: facts["friction"][5].pop(),
        lambda facts, arrays: facts.pop("friction"),
        lambda facts, arrays: facts.pop("filters"),
        lambda facts, arrays: arrays.pop("gear_rigid"),
        lambda facts, arrays: arrays.update(rigid=arrays["rigid"][:-1]),
        lambda facts, arrays: arrays.update(friction=np.append(arrays["friction"], 0.0)),
        lambda facts, arrays: arrays.update(shapes=arrays["shapes"][:, :5]),
        lambda facts, arrays: arrays.update(shapes=arrays["shapes"][:3]),
        lambda facts, arrays: arrays.update(friction=arrays["friction"] * np.nan),
        lambda facts, arrays: arrays.update(rigid=arrays["rigid"] * np.inf),
    ],
)
def test_a_damaged_model_file_is_refused(quick, tmp_path, damage) -> None:
    folder = quick.save(tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    arrays = load_file(folder / "model.safetensors")
    damage(document["fitted"], arrays)
    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, folder / "model.safetensors")
    document["arrays_sha256"] = sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    (folder / "model.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"model\.json") as caught:
        load_model_file(folder)
    assert "fit the model again" in str(caught.value.hint)
