"""Rigid-body estimators by least squares of every kind, on a UR5 whose torques are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import statsmodels.api as sm

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError
from hil.data import Dataset
from hil.data.filters import FilterSettings, zero_phase
from hil.dynamics import base_parameters, friction_terms, joint_columns
from hil.dynamics.inertial import pseudo_inertia
from hil.estimators import estimator
from hil.estimators.friction_curve import power_of_speed
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
    deviation = (fitted.coefficients_ - true_parameters()) / fitted.std_error_
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


@pytest.mark.thorough
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


def test_raw_data_are_prepared_with_the_estimators_own_filters() -> None:
    model = RigidWls(filters={"velocity": 0.3, "acceleration": 0.3}).fit(
        raw(moving(*TRAIN)), nominal()
    )
    assert model.filters == FilterSettings(velocity=0.3, acceleration=0.3)
    test = moving(9)
    inner = slice(50, -50)
    error = model.predict(raw(test)).effort[inner] - test["effort"][inner]
    assert np.sqrt(np.mean(error**2)) < 0.05


def test_motion_that_does_not_excite_is_refused() -> None:
    still = np.zeros((600, 6))
    with pytest.raises(FitError, match="determine only") as caught:
        RigidWls().fit(moving(1).with_columns(qdd_f=still, qd_f=still), nominal())
    assert "excite more" in caught.value.hint


def coloured(data: Dataset, seed: int) -> Dataset:
    """The noise a filtered current has: neighbouring samples share it."""
    random = np.random.default_rng(seed)
    noise = [zero_phase(random.normal(size=(600, 6)), 0.2) for _ in data.conditions]
    return data.with_columns(effort_f=data["effort"] + NOISE_A * np.concatenate(noise))


def true_parameters() -> np.ndarray:
    base = base_parameters(nominal(), rotor=True)
    friction = np.column_stack([COULOMB, VISCOUS, OFFSET]).ravel()
    return np.concatenate([base.combine(plant().parameters(rotor=True)), friction])


def test_standard_errors_hold_though_neighbouring_samples_share_their_noise() -> None:
    clean, deviations, naive = moving(*TRAIN), [], []
    for seed in range(6):
        model = RigidWls().fit(coloured(clean, seed), nominal())
        error = model.coefficients_ - true_parameters()
        deviations.append(error / model.std_error_)
        naive.append(error / (model.std_error_ / np.sqrt(np.mean(model.correlated_samples_))))
    assert np.sqrt(np.mean(np.square(naive))) > 1.7
    assert np.sqrt(np.mean(np.square(deviations))) == pytest.approx(1.0, abs=0.2)


# Classical: OLS, WLS, ridge, total least squares, linear matrix inequalities, robust weights
EVERY = [
    ("rigid-linear", {"method": "ols"}),
    ("rigid-linear", {"method": "wls"}),
    ("rigid-linear", {"method": "ridge"}),
    ("rigid-linear", {"method": "tls"}),
    ("rigid-lmi", {}),
    ("rigid-lmi", {"weighted": True}),
    ("rigid-irls", {"exponent": False, "feasible": False}),
    ("rigid-irls", {}),
]
IDS = [" ".join([name, *map(str, params.values())]) for name, params in EVERY]


def made(name, **params):
    """Prepared columns are exact here: filtering friction again would smear it for nothing."""
    return estimator(name, **{"filter_columns": False, **params})


@pytest.fixture(scope="module")
def data() -> Dataset:
    return moving(*TRAIN, noise_a=NOISE_A)


@cache
def classical(key):
    """One of `EVERY` fitted to `data`."""
    name, params = EVERY[key]
    return made(name, **params).fit(moving(*TRAIN, noise_a=NOISE_A), nominal())


@pytest.mark.thorough
@pytest.mark.parametrize("key", range(len(EVERY)), ids=IDS)
def test_a_new_trajectory_is_predicted_far_below_the_noise(key) -> None:
    test = moving(9)
    error = classical(key).predict(test).effort - test["effort"]
    assert np.max(np.sqrt(np.mean(error**2, axis=0))) < 0.35 * NOISE_A


def stacked(data):
    base = base_parameters(nominal(), rotor=True)
    W = base.reduce(nominal().regressor(data["q_f"], data["qd_f"], data["qdd_f"]))
    friction = joint_columns(friction_terms(data["qd_f"]))
    return np.hstack([W, friction]), (data["effort_f"] * GAINS).ravel()


def test_wls_and_its_hac_errors_are_those_of_statsmodels(data) -> None:
    X, y = stacked(data)
    plain = sm.OLS(y, X).fit()
    # Parameters' degrees of freedom shared equally among the joints.
    degrees = len(data) - X.shape[1] / 6
    sigma = np.sqrt(np.sum(plain.resid.reshape(-1, 6) ** 2, axis=0) / degrees)
    wanted = sm.WLS(y, X, weights=np.tile(1 / sigma**2, len(data))).fit()
    model = classical(1)
    assert model.coefficients_ == pytest.approx(wanted.params, rel=1e-6, abs=1e-9)
    # White noise: heteroscedasticity-consistent errors clustered by instant and lag differ little.
    instants = np.repeat(np.arange(len(data)), 6)
    robust = wanted.get_robustcov_results("cluster", groups=instants).bse
    assert np.median(model.std_error_ / robust) == pytest.approx(1.0, abs=0.1)


def test_least_squares_intervals_hold_the_truth() -> None:
    low, high = classical(1).interval(0.95).T
    assert 0.85 <= np.mean((low <= true_parameters()) & (true_parameters() <= high)) <= 1.0
    assert np.all(classical(1).degrees_ > 10)


@pytest.mark.parametrize("key", [4, 5, pytest.param(7, marks=pytest.mark.thorough)])
def test_links_can_exist_and_friction_takes_energy(key) -> None:
    model = classical(key)
    links = model.inertial_[:60].reshape(6, 10)
    assert np.min(np.linalg.eigvalsh(pseudo_inertia(links))) > 0
    assert np.all(model.inertial_[60:] >= 0)
    assert model.base.combine(model.inertial_) == pytest.approx(model.coefficients_[:40])
    friction = model.coefficients_[40:].reshape(6, 3)
    assert np.all(friction[:, :2] >= 0)
    assert np.all(np.isnan(model.covariance_))


@pytest.mark.thorough
def test_spikes_hardly_move_robust_weights(data) -> None:
    random = np.random.default_rng(0)
    spikes = 3.0 * (random.random(data["effort"].shape) < 0.03)
    spoiled = data.with_columns(effort_f=data["effort_f"] + spikes)
    test = moving(9)

    def error(name, **params):
        found = made(name, **params).fit(spoiled, nominal()).predict(test).effort
        return np.sqrt(np.mean((found - test["effort"]) ** 2))

    robust = {"exponent": False, "feasible": False}
    assert error("rigid-irls", **robust) < 0.5 * error("rigid-linear")
    assert error("rigid-irls", loss="tukey", **robust) < 0.2 * error("rigid-linear")


@pytest.mark.thorough
def test_friction_that_grows_like_a_power_of_speed_is_found() -> None:
    data = moving(*TRAIN, noise_a=0.01)
    change = VISCOUS * (power_of_speed(data["qd_f"], 0.5, 0.01) - data["qd_f"]) / GAINS
    bent = data.with_columns(effort_f=data["effort_f"] + change)
    model = made("rigid-irls", feasible=False).fit(bent, nominal())
    assert model.exponent_ == pytest.approx(0.5, abs=0.05)
    assert model.coefficients_[41::3] == pytest.approx(VISCOUS, rel=0.1)
    straight = made("rigid-irls", feasible=False, exponent=False).fit(bent, nominal())
    assert model.sigma_ == pytest.approx(0.01, rel=0.05)
    assert np.all(model.sigma_ < 0.85 * straight.sigma_)
    stream, test = model.stream(), moving(9, samples=5)
    step = stream.step(test["q_f"][3], test["qd_f"][3], test["qdd_f"][3])
    assert step == pytest.approx(model.predict(test).effort[3], abs=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("filter_columns", [False, True])
def test_friction_is_biased_by_filters_unless_its_columns_are_filtered_too(filter_columns) -> None:
    data = raw(moving(*range(1, 9), noise_a=0.002))
    model = made(
        "rigid-linear",
        filter_columns=filter_columns,
        filters={"velocity": 0.6, "acceleration": 0.2, "effort": 0.2},
    ).fit(data, nominal())
    bias = np.abs(model.coefficients_[40::3] - COULOMB) / COULOMB
    assert (np.mean(bias) < 2e-3) == filter_columns


def test_clustered_errors_need_two_trajectories_and_hold_with_many() -> None:
    with pytest.raises(FitError, match="at least two trajectories") as caught:
        made("rigid-linear", covariance="clustered").fit(moving(1), nominal())
    assert "hac" in caught.value.hint
    data = moving(*range(1, 13), noise_a=NOISE_A, samples=200)
    model = made("rigid-linear", covariance="clustered").fit(data, nominal())
    low, high = model.interval(0.95).T
    assert 0.85 <= np.mean((low <= true_parameters()) & (true_parameters() <= high)) <= 1.0
    assert np.all(model.degrees_ < 12)


def test_ridge_needs_trajectories_to_leave_out_or_a_penalty() -> None:
    with pytest.raises(FitError, match="only one"):
        made("rigid-linear", method="ridge").fit(moving(1), nominal())
    model = made("rigid-linear", method="ridge", alpha=1e-6).fit(moving(1), nominal())
    assert model.alpha_ == 1e-6


@pytest.mark.thorough
def test_a_penalty_and_noise_in_columns_tell_no_intervals() -> None:
    assert np.all(np.isnan(classical(2).interval()))
    assert np.all(np.isnan(classical(3).interval()))
    assert np.all(np.isfinite(classical(1).interval()))


def test_what_the_data_determine_is_told_with_the_model() -> None:
    told = classical(1).fitted_facts()["excitation"]
    assert told["scaled"] == pytest.approx(classical(1).condition_, rel=1e-6)
    assert len(told["worst"]) == 3
    assert 18 <= told["essential"]["count"] < 58
    assert "essential" not in classical(4).fitted_facts()["excitation"]


# On fewer rows than were recorded


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rigid-wls", "rigid-linear"])
def test_a_fit_uses_every_fourth_row_and_predicts_all_of_them(name) -> None:
    data = raw(moving(1, 2, 3))
    whole = estimator(name).fit(data, nominal())
    fewer = estimator(name, filters={"every": 4}).fit(data, nominal())
    assert (whole.samples_, fewer.samples_) == (1800, 450)
    assert len(fewer.predict(data).effort) == 1800
    difference = fewer.predict(data).effort - whole.predict(data).effort
    assert np.sqrt(np.mean(difference**2, axis=0)) == pytest.approx(0.0, abs=0.02)


@pytest.mark.thorough
def test_standard_errors_do_not_grow_with_rows_that_said_nothing_new() -> None:
    data = raw(moving(1, 2, 3))
    noise = np.random.default_rng(0).normal(scale=0.1, size=data["effort"].shape)
    noisy = data.with_columns(effort=data["effort"] + noise)
    whole = estimator("rigid-wls").fit(noisy, nominal())
    fewer = estimator("rigid-wls", filters={"every": 4}).fit(noisy, nominal())
    assert np.median(fewer.std_error_ / whole.std_error_) == pytest.approx(1.0, abs=0.25)


def test_a_fit_says_when_its_rows_are_too_few_for_its_filters() -> None:
    with pytest.raises(DataError, match="too few for signals with a cut-off of 10 Hz"):
        estimator("rigid-wls", filters={"rate_hz": 10.0}).fit(raw(moving(1, 2)), nominal())


@pytest.mark.thorough
@pytest.mark.parametrize("filters", [{}, {"unit": "hz", "velocity": 10, "effort": 3}])
def test_columns_of_fewer_rows_are_rows_of_the_same_columns(filters) -> None:
    data = raw(moving(1, 2))
    model = estimator("rigid-linear", filters={"every": 3, **filters}).fit(data, nominal())
    every = estimator("rigid-linear", filters=filters).fit(data, nominal())
    kept = model._training_rows(data)
    whole = every._training_rows(data)
    rows = np.isin(whole["t"], kept["t"])
    for name, term in model._friction_terms(kept).items():
        assert np.array_equal(term, every._friction_terms(whole)[name][rows])
