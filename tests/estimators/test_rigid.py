"""The rigid-body estimator on a UR5 whose torques are known exactly."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError, SpecError
from hil.data import Dataset
from hil.data.filters import FilterSettings, zero_phase
from hil.dynamics import base_parameters
from hil.estimators import estimator, load_model_file
from hil.estimators.rigid_linear import RigidWls
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    OFFSET,
    VISCOUS,
    fourier,
    moving,
    nominal,
    plant,
    raw,
    true_torque,
)

TRAIN = (1, 2, 3)
NOISE_A = 0.05


@pytest.fixture(scope="module")
def fitted():
    return RigidWls().fit(moving(*TRAIN, noise_a=NOISE_A), nominal())


def test_true_parameters_are_found_within_their_standard_errors(fitted) -> None:
    deviation = (fitted.coefficients_ - truth()) / fitted.std_error_
    assert len(deviation) == len(fitted.parameter_names_)
    assert np.max(np.abs(deviation)) < 4.5
    assert np.sqrt(np.mean(deviation**2)) == pytest.approx(1.0, abs=0.3)


def test_new_trajectory_is_predicted_far_below_the_noise(fitted) -> None:
    test = moving(9)
    error = fitted.predict(test).effort - test["effort"]
    assert np.max(np.sqrt(np.mean(error**2, axis=0))) < 0.2 * NOISE_A


def test_residual_deviation_is_the_noise_of_each_joint(fitted) -> None:
    assert fitted.sigma_ == pytest.approx(NOISE_A, rel=0.1)
    assert fitted.predict(moving(9)).std[0] == pytest.approx(fitted.sigma_)


def test_components_are_the_physical_parts_and_add_up(fitted) -> None:
    test = moving(9)
    prediction = fitted.predict(test)
    parts = prediction.components
    gravity = plant().gravity(test["q"]) / GAINS
    friction = COULOMB * np.tanh(test["qd"] / 0.01) + VISCOUS * test["qd"] + OFFSET
    assert set(parts) == {"gravity", "inertia", "friction", "payload"}
    assert parts["gravity"] == pytest.approx(gravity, abs=0.05)
    assert parts["friction"] == pytest.approx(friction / GAINS, abs=0.05)
    assert sum(parts.values()) == pytest.approx(prediction.effort, abs=1e-12)
    assert prediction.valid.all()


def test_torque_data_are_fitted_and_predicted_in_newton_metres() -> None:
    model = RigidWls().fit(moving(*TRAIN, kind="torque"), nominal())
    _, q, qd, qdd = fourier(9)
    assert model.predict(moving(9, kind="torque")).effort == pytest.approx(
        true_torque(q, qd, qdd), abs=1e-6
    )


def test_weighting_helps_the_quiet_joints() -> None:
    data = moving(*TRAIN)
    loud = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
    noise = loud * np.random.default_rng(5).normal(size=data["effort"].shape)
    data = data.with_columns(effort_f=data["effort"] + noise)
    test = moving(9)

    def wrist_error(weighted):
        model = RigidWls(weighted=weighted).fit(data, nominal())
        error = model.predict(test).effort - test["effort"]
        return np.sqrt(np.mean(error[:, 3:] ** 2))

    assert wrist_error(True) < 0.5 * wrist_error(False)


def test_streaming_sample_by_sample_equals_predicting(fitted) -> None:
    test = moving(9, samples=50)
    stream = fitted.stream()
    steps = [
        stream.step(*motion)
        for motion in zip(test["q_f"], test["qd_f"], test["qdd_f"], strict=True)
    ]
    assert np.array(steps) == pytest.approx(fitted.predict(test).effort, abs=1e-10)


def test_declared_load_is_taken_out_of_the_fit_and_put_into_predictions(fitted) -> None:
    loaded = moving(9, load=LOAD)
    assert fitted.predict(loaded).effort == pytest.approx(loaded["effort"], abs=0.05)
    unloaded = replace(
        loaded, conditions=tuple(replace(c, payload=Payload()) for c in loaded.conditions)
    )
    assert np.max(np.abs(fitted.predict(unloaded).effort - loaded["effort"])) > 0.5
    with_load = RigidWls().fit(moving(*TRAIN, load=LOAD), nominal())
    bare = moving(9)
    assert with_load.predict(bare).effort == pytest.approx(bare["effort"], abs=1e-6)


def test_stream_carries_a_declared_load(fitted) -> None:
    loaded = moving(9, load=LOAD, samples=20)
    stream = fitted.stream(LOAD)
    motion = (loaded["q_f"][7], loaded["qd_f"][7], loaded["qdd_f"][7])
    assert stream.step(*motion) == pytest.approx(fitted.predict(loaded).effort[7])


def test_raw_data_are_prepared_with_the_estimators_own_filters() -> None:
    model = RigidWls(filters={"velocity": 0.3, "acceleration": 0.3}).fit(
        raw(moving(*TRAIN)), nominal()
    )
    assert model.filters == FilterSettings(velocity=0.3, acceleration=0.3)
    test = moving(9)
    inner = slice(50, -50)
    error = model.predict(raw(test)).effort[inner] - test["effort"][inner]
    assert np.sqrt(np.mean(error**2)) < 0.05


def spoiled(data: Dataset, **changes: object) -> Dataset:
    return replace(data, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("data", "message", "remedy"),
    [
        (lambda: moving(1, samples=40), "40 samples are too few", "record more"),
        (
            lambda: spoiled(moving(1), drive_gains=None),
            "drive gains .* are unknown",
            "drive_gains_nm_a",
        ),
        (lambda: spoiled(moving(1), robot="ur10e"), "recorded on a ur10e", "--robot ur10e"),
        (
            lambda: spoiled(moving(1), joint_names=tuple(reversed(nominal().joint_names))),
            "list the joints as wrist_3_joint",
            "import the recording again",
        ),
        (
            lambda: moving(1).with_columns(q=moving(1)["q"] * [1, 1, 1, 1, 0, 1]),
            "wrist_2_joint never moved",
            "every joint moves",
        ),
        (
            lambda: moving(1).with_columns(effort=np.full((600, 6), np.nan)),
            "3600 values of effort are not finite",
            "--drop-bad-rows",
        ),
        (
            lambda: moving(1).with_columns(qdd_f=np.zeros((600, 6)), qd_f=np.zeros((600, 6))),
            "determine only",
            "excite more",
        ),
    ],
    ids=["short", "gains", "robot", "order", "still", "nan", "rank"],
)
def test_data_that_cannot_be_fitted_get_one_clear_error(data, message, remedy) -> None:
    with pytest.raises(FitError, match=message) as caught:
        RigidWls().fit(data(), nominal())
    assert remedy in caught.value.hint


def test_model_refuses_data_in_another_unit(fitted) -> None:
    with pytest.raises(DataError, match="predicts a current, the data hold a torque"):
        fitted.predict(moving(9, kind="torque"))


def test_unfitted_model_says_so() -> None:
    with pytest.raises(FitError, match="not fitted yet"):
        RigidWls().predict(moving(9))


IMPOSSIBLE = [
    ("sign_width", -0.1, "sign_width is -0.1, but must be a number at least 0"),
    ("sign_width", float("nan"), "sign_width is nan"),
    ("sign_width", "abc", "sign_width is 'abc', but must be a number"),
    ("sign_width", True, "sign_width is True"),
    ("sign_width", [0.1], r"sign_width is \[0.1\]"),
    ("weighted", "abc", "weighted is 'abc', but must be true or false"),
    ("filters", {"velocity": -1}, r"filters\.velocity: .*greater than 0"),
    ("filters", {"speed": 1}, "filters has no parameter 'speed'"),
    ("filters", 3, "filters: "),
]


@pytest.mark.parametrize(("name", "value", "message"), IMPOSSIBLE)
def test_values_that_cannot_be_are_refused_by_name_however_they_come(name, value, message) -> None:
    model = RigidWls(sign_width=0.02)
    for attempt in (RigidWls, model.set_params, partial(estimator, "rigid-wls")):
        with pytest.raises(SpecError, match=message):
            attempt(**{name: value})
    assert model.get_params() == RigidWls(sign_width=0.02).get_params()


def coloured(data: Dataset, seed: int) -> Dataset:
    """The noise a filtered current has: neighbouring samples share it."""
    random = np.random.default_rng(seed)
    noise = [zero_phase(random.normal(size=(600, 6)), 0.2) for _ in data.conditions]
    return data.with_columns(effort_f=data["effort"] + NOISE_A * np.concatenate(noise))


def truth() -> np.ndarray:
    base = base_parameters(nominal(), rotor=True)
    friction = np.column_stack([COULOMB, VISCOUS, OFFSET]).ravel()
    return np.concatenate([base.combine(plant().parameters(rotor=True)), friction])


def test_standard_errors_hold_though_neighbouring_samples_share_their_noise() -> None:
    clean, deviations, naive = moving(*TRAIN), [], []
    for seed in range(6):
        model = RigidWls().fit(coloured(clean, seed), nominal())
        error = model.coefficients_ - truth()
        deviations.append(error / model.std_error_)
        naive.append(error / (model.std_error_ / np.sqrt(np.mean(model.correlated_samples_))))
    assert np.sqrt(np.mean(np.square(naive))) > 1.7
    assert np.sqrt(np.mean(np.square(deviations))) == pytest.approx(1.0, abs=0.2)


def test_model_file_says_what_its_standard_errors_take_for_granted(fitted, tmp_path) -> None:
    folder = fitted.save(tmp_path / "model")
    document = json.loads((folder / "model.json").read_text("utf-8"))
    said = document["fitted"]["std_error"]
    assert "given exact drive gains" in "given " + said["given"]
    assert "noise in the regressor" in said["leaves_out"]
    assert said["correlated_samples"] == pytest.approx([1.0] * 6, abs=0.3)
    assert load_model_file(folder).correlated_samples_.tolist() == said["correlated_samples"]
