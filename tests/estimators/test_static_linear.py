"""The paper's five methods: scikit-learn's and statsmodels' numbers on the same matrices."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import statsmodels.api as sm
from sklearn.linear_model import ElasticNet, Lasso, LinearRegression, Ridge

from hil.core.errors import FitError, SpecError
from hil.data import Dataset
from hil.data.splits import split
from hil.dynamics import base_parameters
from hil.estimators import estimator, load_model_file, save_model
from hil.estimators.static_linear import StaticLinear
from hil.estimators.static_model import PAPER_PROTOCOL, StaticWls
from tests.estimators.test_paper_protocol import own_regressor
from tests.support.synthetic_motion import GAINS, LOAD, dwelling, nominal, plant

PENALTY = {"tol": 1e-8, "max_iter": 100_000}
THEIRS = {
    "ls": LinearRegression(),
    "ridge": Ridge(alpha=0.001),
    "lasso": Lasso(alpha=0.001, **PENALTY),
    "elastic-net": ElasticNet(alpha=0.001, l1_ratio=0.5, **PENALTY),
}
OPTIONS = [(rows, term) for rows in ("dwells", "samples") for term in (False, True)]


@cache
def data() -> Dataset:
    return dwelling(60, stiction_nm=2.0, both=True)


@cache
def fitted(**params) -> StaticLinear:
    return StaticLinear(**params).fit(data(), nominal())


def rows_of(dataset, kind):
    """q and current of one row a dwell, or of all."""
    q, current = dataset["q"], dataset["effort"]
    if kind == "samples":
        return q, current
    return q.reshape(-1, 10, 6).mean(axis=1), current.reshape(-1, 10, 6).mean(axis=1)


def matrix(joint, rows, term):
    """R_j of eq. 20 with its column of ones last, and the current."""
    q, current = rows_of(data(), rows)
    R = own_regressor(joint, q, current[:, joint])
    return R if term else np.delete(R, -2, axis=1), current[:, joint]


def own(model, joint, values=None):
    """A joint's parameters in the order of eq. 20, and the unit of the current."""
    mine = (f"joint{joint + 1}.", f"{model.joint_names_[joint]}.")
    chosen = [name.startswith(mine) for name in model.parameter_names_]
    return (model.coefficients_ if values is None else values)[chosen] / GAINS[joint]


@pytest.mark.thorough
@pytest.mark.parametrize(("rows", "term"), OPTIONS)
@pytest.mark.parametrize("method", THEIRS)
def test_solutions_are_scikit_learns(method, rows, term) -> None:
    model = fitted(method=method, rows=rows, current_term=term)
    for joint in range(6):
        R, current = matrix(joint, rows, term)
        if R.shape[1] > 1:
            theirs = THEIRS[method].fit(R[:, :-1], current)
            found = np.append(theirs.coef_, theirs.intercept_)
        else:
            found = np.array([np.mean(current)])
        np.testing.assert_allclose(own(model, joint), found, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("method", ["ridge", "lasso", "elastic-net"])
def test_no_penalty_is_least_squares(method) -> None:
    found = fitted(method=method, alpha=0.0).coefficients_
    np.testing.assert_allclose(found, fitted().coefficients_, atol=1e-9)


@pytest.mark.parametrize("joint", [1, 3])
def test_standardised_penalties_are_scikit_learns_on_scaled_columns(joint) -> None:
    R, current = matrix(joint, "dwells", True)
    scale = R[:, :-1].std(axis=0)
    theirs = Lasso(alpha=0.01, **PENALTY).fit(R[:, :-1] / scale, current)
    model = fitted(method="lasso", alpha=0.01, standardise=True, current_term=True)
    np.testing.assert_allclose(own(model, joint)[:-1], theirs.coef_ / scale, atol=1e-8)


def repeats_weight(joint):
    """1/variance of the ten samples, shrunk towards the mean as by four more observations would."""
    variance = data()["effort"][:, joint].reshape(-1, 10).var(axis=1, ddof=1)
    return 13.0 / (4.0 * variance.mean() + 9.0 * variance)


def paper_weight(joint):
    """1/variance of a pose's two dwells about a least-squares fit, with the same four."""
    R, current = matrix(joint, "dwells", False)
    residual = current - R @ np.linalg.lstsq(R, current)[0]
    mean_square = (residual**2).reshape(-1, 2).mean(axis=1)
    return np.repeat(5.0 / (4.0 * mean_square.mean() + mean_square), 2)


@pytest.mark.parametrize(
    ("weights", "weight"), [("repeats", repeats_weight), ("paper", paper_weight)]
)
def test_wls_is_that_of_statsmodels_with_the_documented_weights(weights, weight) -> None:
    model = fitted(method="wls", weights=weights)
    for joint in range(6):
        R, current = matrix(joint, "dwells", False)
        theirs = sm.WLS(current, R, weights=weight(joint)).fit()
        np.testing.assert_allclose(own(model, joint), theirs.params, rtol=1e-8, atol=1e-10)


def test_every_pose_counts_once_with_weights_pose() -> None:
    some = data().select(lambda c: c.approach == 1 or c.pose < 20)
    weighted = StaticLinear(method="wls", weights="pose").fit(some, nominal())
    q, current = rows_of(some, "dwells")
    pose = np.array([c.pose for c in some.conditions])
    weight = np.where(pose < 20, 0.5, 1.0)
    theirs = sm.WLS(
        current[:, 2], own_regressor(2, q, current[:, 2])[:, [0, 1, 2, 4]], weight
    ).fit()
    np.testing.assert_allclose(own(weighted, 2), theirs.params, rtol=1e-8)


def test_least_squares_agrees_with_the_estimator_that_solves_jointly() -> None:
    joint = StaticWls(form="paper").fit(data(), nominal())
    np.testing.assert_allclose(fitted().coefficients_, joint.coefficients_, atol=1e-9)
    assert fitted(form="shared").parameter_names_[:2] == base_names()[:2]


def base_names():
    return base_parameters(nominal(), gravity_only=True).names


def test_shared_form_solves_for_all_joints_at_once() -> None:
    model, means = fitted(form="shared"), [rows_of(data(), "dwells")][0]
    W = base_parameters(nominal(), gravity_only=True).reduce(nominal().gravity_regressor(means[0]))
    X = np.hstack([W, np.tile(np.eye(6), (len(means[0]), 1))])
    theirs = np.linalg.lstsq(X, (means[1] * GAINS).ravel())[0]
    np.testing.assert_allclose(model.coefficients_, theirs, atol=1e-8)


def test_repeats_weigh_the_joints_of_the_shared_form_in_the_unit_of_their_torques() -> None:
    model = fitted(method="wls", form="shared", weights="repeats")
    in_torque = replace(
        data(),
        columns={**data().columns, "effort": data()["effort"] * np.array(GAINS)},
        effort_kind="torque",
        drive_gains=None,
    )
    same = StaticLinear(method="wls", form="shared", weights="repeats").fit(in_torque, nominal())
    assert model.coefficients_ == pytest.approx(same.coefficients_, rel=1e-6, abs=1e-9)


def test_ridge_of_the_shared_form_leaves_offsets_unpenalised() -> None:
    model, (q, current) = (
        fitted(form="shared", method="ridge", alpha=10.0),
        rows_of(data(), "dwells"),
    )
    W = base_parameters(nominal(), gravity_only=True).reduce(nominal().gravity_regressor(q))
    X = np.hstack([W, np.tile(np.eye(6), (len(q), 1))])
    penalty = np.diag([10.0] * W.shape[1] + [0.0] * 6)
    theirs = np.linalg.solve(X.T @ X + penalty, X.T @ (current * GAINS).ravel())
    np.testing.assert_allclose(model.coefficients_, theirs, rtol=1e-7, atol=1e-9)


def test_ten_samples_of_a_dwell_count_once_in_standard_errors() -> None:
    sided = dwelling(60, stiction_nm=2.0)
    once, ten = (StaticLinear(rows=rows).fit(sided, nominal()) for rows in ("dwells", "samples"))
    np.testing.assert_allclose(ten.std_error_, once.std_error_, rtol=0.02)
    R = np.delete(own_regressor(1, sided["q"], sided["effort"][:, 1]), -2, axis=1)
    naive = sm.OLS(sided["effort"][:, 1], R).fit()
    assert np.all(own(ten, 1, ten.std_error_) > 2 * naive.bse)


def test_true_gravity_lies_in_the_intervals_as_often_as_they_say() -> None:
    truth = base_parameters(nominal(), gravity_only=True).combine(plant().parameters(rotor=False))
    hits = []
    for seed in range(12):
        one_sided = dwelling(25, seed=seed, stiction_nm=2.0)
        low, high = StaticLinear(form="shared").fit(one_sided, nominal()).interval(0.9).T
        hits.append((low[: len(truth)] <= truth) & (truth <= high[: len(truth)]))
    assert 0.84 < np.mean(hits) < 0.96


@pytest.mark.thorough
@pytest.mark.parametrize("noise", ["normal", "student"])
def test_intervals_know_that_the_papers_weights_come_from_the_same_data(noise) -> None:
    from hil.estimators.static_linear import Block, DwellSeries, least_squares

    random = np.random.default_rng(2)
    X = np.column_stack([random.normal(size=(40, 2)), np.ones(40)])
    index = np.arange(40)
    series = DwellSeries(index, np.zeros((40, 1)), np.full(40, 10))
    estimates, told = [], []
    for _ in range(120):
        y = random.normal(size=40) if noise == "normal" else random.standard_t(4, size=40)
        block = Block(X, y, np.zeros(40, dtype=int), index, {0: 2}, series)
        found = least_squares(block, "paper")
        estimates.append(found.coefficients)
        told.append(np.diag(found.covariance))
    ratio = np.sqrt(np.mean(told) / np.mean(np.var(estimates, axis=0)))
    assert ratio == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("method", ["ridge", "lasso", "elastic-net"])
def test_penalised_methods_tell_no_intervals_and_say_so(method) -> None:
    model = fitted(method=method)
    assert np.isnan(model.interval()).all()
    assert model.fitted_facts()["std_error"]["given"].startswith("none: a penalty")


@pytest.mark.parametrize("params", [{}, {"method": "wls"}, {"method": "lasso"}, {"form": "shared"}])
def test_new_poses_and_loads_are_predicted_within_the_noise(params) -> None:
    parts = split(dwelling(120, both=True, noise_a=0.001), "pose", 0.3)
    model = StaticLinear(**params).fit(parts.train, nominal())
    limit = 0.02 if params.get("method") == "lasso" else 0.002
    for test in (parts.test, dwelling(20, seed=4, load=LOAD, noise_a=0.001)):
        error = model.predict(test).effort - test["effort"]
        assert np.sqrt(np.mean(error**2, axis=0)).max() < limit


def test_stored_models_keep_intervals_and_predictions(tmp_path) -> None:
    model = fitted(method="wls")
    again = load_model_file(save_model(model, tmp_path / "m"))
    assert again.interval(0.9) == pytest.approx(model.interval(0.9))
    assert again.predict(data()).effort == pytest.approx(model.predict(data()).effort)
    assert (again.poses_, again.get_params()) == (60, model.get_params())


def test_models_are_labelled_by_what_they_saw() -> None:
    assert fitted().protocol == "honest"
    assert fitted(current_term=True).protocol == PAPER_PROTOCOL
    assert estimator("static-linear", method="ridge").alpha == 0.001


def test_short_dwells_are_used_as_they_are_and_noted() -> None:
    keep = np.ones(len(data()), dtype=bool)
    keep[3:10] = False
    from hil.data.dataset import rows_of as cut

    model = StaticLinear(method="wls", weights="repeats").fit(cut(data(), keep), nominal())
    assert model.notes_ == (
        "1 of 120 dwells have fewer than 10 samples (the shortest 3); each is used as it is",
    )
    assert np.all(np.isfinite(model.coefficients_))


def changed(q=None, effort=None) -> Dataset:
    columns = dict(data().columns)
    columns |= {"q": q} if q is not None else {}
    columns |= {"effort": effort} if effort is not None else {}
    return replace(data(), columns=columns)


def with_wrist_still():
    q = data()["q"].copy()
    q[:, 4] = 0.3 + 1e-5 * np.random.default_rng(0).normal(size=len(q))
    return changed(q=q)


def with_gripper_level():
    q = data()["q"].copy()
    q[:, 3] = 1.0 - q[:, 1] - q[:, 2]
    return changed(q=q)


def with_a_nan():
    effort = data()["effort"].copy()
    effort[17, 2] = np.nan
    return changed(effort=effort)


@pytest.mark.parametrize("method", ["ls", "wls", "ridge", "lasso"])
@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        (lambda: data().select(lambda c: c.pose < 7), "7 poses are too few: at least 8"),
        (with_wrist_still, "wrist_2_joint never moved"),
        (with_gripper_level, "joint3.phi1, joint4.phi1 is the same at every pose"),
        (with_a_nan, "effort.*not finite|not finite.*effort|effort"),
    ],
    ids=["poses", "still", "constant", "nan"],
)
def test_bad_data_end_in_one_clear_error(method, spoiled, message) -> None:
    with pytest.raises(FitError, match=message):
        StaticLinear(method=method).fit(spoiled(), nominal())


def test_axes_that_gravity_does_not_depend_on_may_stand_still() -> None:
    q = data()["q"].copy()
    q[:, 0] = 0.5
    assert StaticLinear().fit(changed(q=q), nominal()).poses_ == 60


@pytest.mark.parametrize(
    "params",
    [
        {"method": "lars"},
        {"weights": "equal"},
        {"rows": "all"},
        {"alpha": -1.0},
        {"l1_ratio": 1.5},
        {"standardise": 1},
        {"form": "shared", "current_term": True},
        {"form": "shared", "method": "lasso"},
    ],
)
def test_parameters_that_cannot_be_are_refused(params) -> None:
    with pytest.raises(SpecError, match=list(params)[-1]):
        StaticLinear(**params)
