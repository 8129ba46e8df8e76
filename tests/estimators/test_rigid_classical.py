"""The classical estimators on a UR5 whose torques are known exactly."""

import numpy as np
import pytest
import statsmodels.api as sm

from hil.core.errors import FitError, SpecError
from hil.data.dataset import Dataset
from hil.dynamics import base_parameters, friction_terms, joint_columns
from hil.dynamics.inertial import pseudo_inertia
from hil.estimators import estimator, load_model_file
from hil.estimators.friction_curve import power_of_speed
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    OFFSET,
    VISCOUS,
    moving,
    nominal,
    plant,
    raw,
)

TRAIN = (1, 2, 3)
NOISE_A = 0.05
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


@pytest.fixture(scope="module")
def fitted(data):
    return {key: made(name, **p).fit(data, nominal()) for key, (name, p) in enumerate(EVERY)}


def truth():
    base = base_parameters(nominal(), rotor=True).combine(plant().parameters())
    return np.concatenate([base, np.stack([COULOMB, VISCOUS, OFFSET], axis=1).ravel()])


@pytest.mark.thorough
@pytest.mark.parametrize("key", range(len(EVERY)), ids=IDS)
def test_a_new_trajectory_is_predicted_far_below_the_noise(fitted, key) -> None:
    test = moving(9)
    error = fitted[key].predict(test).effort - test["effort"]
    assert np.max(np.sqrt(np.mean(error**2, axis=0))) < 0.35 * NOISE_A


@pytest.mark.parametrize("key", range(len(EVERY)), ids=IDS)
def test_a_model_file_predicts_and_tells_what_the_model_does(fitted, key, tmp_path) -> None:
    model, test = fitted[key], moving(9, samples=60)
    again = load_model_file(model.save(tmp_path / "model"))
    assert again.get_params() == model.get_params()
    assert again.predict(test).effort == pytest.approx(model.predict(test).effort, abs=1e-12)
    assert again.interval(0.9) == pytest.approx(model.interval(0.9), nan_ok=True)
    assert again.fitted_facts().keys() == model.fitted_facts().keys()
    for name, values in model.fitted_arrays().items():
        assert again.fitted_arrays()[name] == pytest.approx(values, nan_ok=True)


def stacked(data):
    base = base_parameters(nominal(), rotor=True)
    W = base.reduce(nominal().regressor(data["q_f"], data["qd_f"], data["qdd_f"]))
    friction = joint_columns(friction_terms(data["qd_f"]))
    return np.hstack([W, friction]), (data["effort_f"] * GAINS).ravel()


def test_wls_and_its_hac_errors_are_those_of_statsmodels(data, fitted) -> None:
    X, y = stacked(data)
    plain = sm.OLS(y, X).fit()
    # Parameters' degrees of freedom shared equally among the joints.
    degrees = len(data) - X.shape[1] / 6
    sigma = np.sqrt(np.sum(plain.resid.reshape(-1, 6) ** 2, axis=0) / degrees)
    wanted = sm.WLS(y, X, weights=np.tile(1 / sigma**2, len(data))).fit()
    model = fitted[1]
    assert model.coefficients_ == pytest.approx(wanted.params, rel=1e-6, abs=1e-9)
    # White noise: heteroscedasticity-consistent errors clustered by instant and lag differ little.
    instants = np.repeat(np.arange(len(data)), 6)
    robust = wanted.get_robustcov_results("cluster", groups=instants).bse
    assert np.median(model.std_error_ / robust) == pytest.approx(1.0, abs=0.1)


def test_least_squares_intervals_hold_the_truth(fitted) -> None:
    low, high = fitted[1].interval(0.95).T
    assert 0.85 <= np.mean((low <= truth()) & (truth() <= high)) <= 1.0
    assert np.all(fitted[1].degrees_ > 10)


def test_links_can_exist_and_friction_takes_energy(fitted) -> None:
    for key in (4, 5, 7):
        model = fitted[key]
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
    assert 0.85 <= np.mean((low <= truth()) & (truth() <= high)) <= 1.0
    assert np.all(model.degrees_ < 12)


def test_ridge_needs_trajectories_to_leave_out_or_a_penalty() -> None:
    with pytest.raises(FitError, match="only one"):
        made("rigid-linear", method="ridge").fit(moving(1), nominal())
    model = made("rigid-linear", method="ridge", alpha=1e-6).fit(moving(1), nominal())
    assert model.alpha_ == 1e-6


def test_a_penalty_and_noise_in_columns_tell_no_intervals(fitted) -> None:
    assert np.all(np.isnan(fitted[2].interval()))
    assert np.all(np.isnan(fitted[3].interval()))
    assert np.all(np.isfinite(fitted[1].interval()))


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"method": "lasso"}, "method is 'lasso'"),
        ({"alpha": 0.1}, "alpha belongs to method ridge"),
        ({"covariance": "white"}, "covariance is 'white'"),
    ],
)
def test_parameters_that_cannot_be_are_refused(params, message) -> None:
    with pytest.raises(SpecError, match=message):
        estimator("rigid-linear", **params)


def test_what_the_data_determine_is_told_with_the_model(fitted) -> None:
    told = fitted[1].fitted_facts()["excitation"]
    assert told["scaled"] == pytest.approx(fitted[1].condition_, rel=1e-6)
    assert len(told["worst"]) == 3
    assert 18 <= told["essential"]["count"] < 58
    assert "essential" not in fitted[4].fitted_facts()["excitation"]


def test_a_load_that_was_declared_is_no_part_of_the_arm() -> None:
    loaded = moving(*TRAIN, load=LOAD)
    model = made("rigid-lmi").fit(loaded, nominal())
    test = moving(9)
    assert model.predict(test).effort == pytest.approx(test["effort"], abs=0.02)
