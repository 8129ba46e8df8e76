"""Gravity at rest by linear models: base parameters, the paper's columns and its five methods."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import statsmodels.api as sm
from sklearn.linear_model import ElasticNet, Lasso, LinearRegression, Ridge

from hil.core.errors import FitError
from hil.data import Conditions, Dataset
from hil.data.dataset import rows_of as cut
from hil.data.splits import split
from hil.dynamics import base_parameters, load_model
from hil.estimators import estimator
from hil.estimators.static_linear import Block, DwellSeries, StaticLinear, least_squares
from hil.estimators.static_model import (
    CURRENT_PART,
    PAPER_PROTOCOL,
    StaticWls,
    paper_functions,
    signed_square,
)
from tests.support.synthetic_motion import (
    GAINS,
    LOAD,
    OFFSET,
    dataset,
    dwelling,
    moving,
    nominal,
    plant,
)

POSES = np.random.default_rng(9).uniform(-2.5, 2.5, (200, 6))


def held_out_error(model):
    """RMSE per joint [A] at new poses."""
    test = dwelling(200, seed=5, noise_a=0.0)
    return np.sqrt(np.mean((model.predict(test).effort - test["effort"]) ** 2, axis=0))


@pytest.mark.parametrize("form", ["shared", "paper"])
def test_gravity_of_new_poses_is_predicted_within_the_noise(form) -> None:
    model = StaticWls(form=form).fit(dwelling(80, noise_a=0.002), nominal())
    assert np.max(held_out_error(model)) < 0.002


def test_parts_are_gravity_and_offset() -> None:
    model = StaticWls().fit(dwelling(80, noise_a=0.0), nominal())
    test = dwelling(20, seed=3, noise_a=0.0)
    prediction = model.predict(test)
    gravity = plant().gravity(test["q"]) / GAINS
    assert prediction.components["gravity"] == pytest.approx(gravity, abs=1e-6)
    assert prediction.components["offset"][0] == pytest.approx(OFFSET / GAINS, abs=1e-6)
    assert sum(prediction.components.values()) == pytest.approx(prediction.effort)


def test_both_approaches_average_stuck_friction_out() -> None:
    one_sided = StaticWls().fit(dwelling(60, seed=1, stiction_nm=3.0), nominal())
    two_sided = StaticWls().fit(dwelling(60, seed=1, stiction_nm=3.0, both=True), nominal())
    assert np.max(held_out_error(two_sided)) < 0.005
    assert np.max(held_out_error(one_sided)) > 0.02


def test_standard_errors_count_dwells_not_samples() -> None:
    few = dwelling(60, noise_a=0.0, stiction_nm=1.0)
    repeated = Dataset(
        **{
            **vars(few),
            "columns": {name: np.repeat(few[name], 10, axis=0) for name in few.columns},
            "offsets": few.offsets * 10,
        }
    )
    ten, hundred = (StaticWls().fit(data, nominal()) for data in (few, repeated))
    assert ten.samples_ == 60
    assert hundred.std_error_ == pytest.approx(ten.std_error_, rel=1e-6)


def test_papers_columns_span_gravity() -> None:
    # The paper sets some centres of mass to zero; the UR5 of `hil.arms` has the same zeros.
    gravity = plant().gravity(POSES)
    for joint, functions in enumerate(paper_functions(POSES), start=1):
        fit = np.linalg.lstsq(functions, gravity[:, joint], rcond=None)
        assert functions @ fit[0] == pytest.approx(gravity[:, joint], abs=1e-9)
    assert np.abs(gravity[:, 0]).max() < 1e-9


def test_papers_form_needs_no_drive_gains_for_currents() -> None:
    data = replace(dwelling(80), drive_gains=None)
    model = StaticWls(form="paper").fit(data, nominal())
    assert np.max(held_out_error(model)) < 0.003
    with pytest.raises(FitError, match="drive gains"):
        StaticWls().fit(data, nominal())


@pytest.mark.parametrize("form", ["shared", "paper"])
def test_load_is_taken_out_of_the_fit_and_put_into_predictions(form) -> None:
    model = StaticWls(form=form).fit(dwelling(80, load=LOAD, noise_a=0.0), nominal())
    assert np.max(held_out_error(model)) < 1e-6
    loaded = dwelling(20, seed=3, load=LOAD, noise_a=0.0)
    assert model.predict(loaded).effort == pytest.approx(loaded["effort"], abs=1e-6)


def test_rows_in_motion_are_predicted_but_not_valid() -> None:
    model = StaticWls().fit(dwelling(80), nominal())
    data = moving(4)
    slow = np.max(np.abs(data["qd"]), axis=1) < model.rest_speed
    valid = model.predict(data).valid
    assert not slow.all()
    assert np.array_equal(valid.all(axis=1), slow)
    assert model.predict(dwelling(5)).valid.all()


def test_stays_within_a_motion_without_a_plan_are_used() -> None:
    stays = dwelling(60, noise_a=0.0)
    t, q, effort, qd = 0.0, [], [], []
    for _, rows in stays.slices():
        jump = np.full((1, 6), 1.0)
        q += [stays["q"][rows][:1], np.repeat(stays["q"][rows], 2, axis=0)]
        qd += [jump, np.zeros((20, 6))]
        effort += [np.zeros((1, 6)), np.repeat(stays["effort"][rows], 2, axis=0)]
    columns = {"q": np.concatenate(q), "qd": np.concatenate(qd), "effort": np.concatenate(effort)}
    columns["t"] = t + 0.008 * np.arange(len(columns["q"]))
    motion = replace(
        stays,
        columns=columns,
        offsets=np.array([0, len(columns["q"])]),
        conditions=(Conditions("all", "trajectory", "run", 0),),
    )
    model = StaticWls().fit(motion, nominal())
    assert model.samples_ == 60
    assert np.max(held_out_error(model)) < 1e-6


def test_papers_form_is_refused_for_other_arms(tmp_path) -> None:
    joints = "".join(
        f'<link name="l{i + 1}"><inertial><mass value="1"/><origin xyz="0.1 0 0"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
        '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="1"/></joint>'
        for i in range(2)
    )
    urdf = tmp_path / "two.urdf"
    urdf.write_text(f'<robot name="two"><link name="l0"/>{joints}</robot>')
    data = dwelling(40)
    two = {name: v if name == "t" else v[:, :2] for name, v in data.columns.items()}
    data = replace(data, columns=two, joint_names=("j0", "j1"), drive_gains=GAINS[:2], robot="two")
    with pytest.raises(FitError, match="six-joint UR arms"):
        StaticWls(form="paper").fit(data, load_model(urdf))


# Eq. 16 to 20 of the static paper as printed: the measured current among the inputs

K2, K1, K0 = 0.6, 11.0, 0.8


def paper_model(data):
    return StaticWls(form="paper", current_term=True).fit(data, nominal())


@pytest.fixture(scope="module")
def data():
    return dwelling(80, stiction_nm=2.0)


@pytest.fixture(scope="module")
def model(data):
    return paper_model(data)


def own_regressor(joint, q, i):
    """R_i of eq. 20 for one joint (from 0)."""
    none = np.empty((len(q), 0))
    phi = (none, *paper_functions(q), none)[joint]
    return np.column_stack([phi, i**2 * np.sign(i), np.ones(len(q))])


def means(data):
    return (data[name].reshape(-1, 10, 6).mean(axis=1) for name in ("q", "effort"))


def coefficients_of(model, joint):
    """In the order of eq. 20 and in the unit of the current."""
    mine = (f"joint{joint + 1}.", f"{model.joint_names_[joint]}.")
    chosen = [name.startswith(mine) for name in model.parameter_names_]
    return model.coefficients_[chosen] / model.torque_scale_[joint]


def test_the_column_is_the_signed_square_of_eq_16() -> None:
    current = np.array([[2.0, -3.0, 0.0]])
    assert signed_square(current).tolist() == [[4.0, -9.0, 0.0]]


@pytest.mark.parametrize("joint", range(6))
def test_solution_is_numpys_on_the_matrix_of_eq_20(data, model, joint) -> None:
    q, current = means(data)
    R = own_regressor(joint, q, current[:, joint])
    expected = np.linalg.lstsq(R, current[:, joint], rcond=None)[0]
    np.testing.assert_allclose(coefficients_of(model, joint), expected, rtol=1e-8, atol=1e-12)


def test_prediction_is_eq_20_with_the_measured_current(data, model) -> None:
    q, current = data["q"], data["effort"]
    expected = [
        own_regressor(j, q, current[:, j]) @ coefficients_of(model, j) for j in range(len(GAINS))
    ]
    prediction = model.predict(data)
    np.testing.assert_allclose(prediction.effort, np.transpose(expected), atol=1e-9)
    np.testing.assert_allclose(sum(prediction.components.values()), prediction.effort, atol=1e-12)


def test_motor_constants_come_back_as_the_ratios_of_eq_19() -> None:
    where = dwelling(120, noise_a=0.0)
    torque = plant().gravity(where["q"])
    # τ = K2·i²·sign(i) + K1·i + K0 solved for the current, without friction or noise.
    rest = torque - K0
    current = np.sign(rest) * (np.sqrt(K1**2 + 4 * K2 * np.abs(rest)) - K1) / (2 * K2)
    columns = {**where.columns, "effort": current}
    exact = dataset(columns, [10] * 120, list(where.conditions))
    # Joints 1 and 6 carry no gravity: their current is constant and tells nothing about K2.
    noise = 1e-7 * np.random.default_rng(0).normal(size=current.shape)
    fitted = paper_model(exact.with_columns(effort=current + noise))
    for joint in (1, 2, 3):
        ratios = -coefficients_of(fitted, joint)[-2:]
        np.testing.assert_allclose(ratios, [K2 / K1, K0 / K1], rtol=1e-3)


def test_the_model_and_its_prediction_say_what_they_saw(data, model) -> None:
    assert model.protocol == "paper: the measured current is among the inputs"
    assert CURRENT_PART in model.predict(data).components
    assert "paper protocol" in CURRENT_PART


def test_without_the_term_models_are_honest(data) -> None:
    honest = StaticWls(form="paper").fit(data, nominal())
    assert StaticWls().current_term is False
    assert honest.protocol == "honest"
    assert set(honest.predict(data).components) == {"gravity", "offset", "payload"}


def test_streaming_is_refused_for_want_of_the_current(model) -> None:
    with pytest.raises(FitError, match="prediction of the current needs the measured current"):
        model.stream()


def test_papers_form_is_refused_off_a_level_base(data) -> None:
    with pytest.raises(FitError, match="level base"):
        StaticWls(form="paper").fit(data, load_model("ur5", gravity=(-9.81, 0.0, 0.0)))


def test_a_load_unseen_in_training_is_added_as_a_current() -> None:
    model = StaticWls(form="paper").fit(dwelling(80, noise_a=0.0), nominal())
    loaded = dwelling(20, seed=3, load=LOAD, noise_a=0.0)
    assert model.predict(loaded).effort == pytest.approx(loaded["effort"], abs=1e-6)


def test_a_load_is_refused_where_no_drive_gains_are_known() -> None:
    model = StaticWls(form="paper").fit(replace(dwelling(80), drive_gains=None), nominal())
    with pytest.raises(FitError, match="without drive gains"):
        model.predict(dwelling(20, seed=3, load=LOAD))
    with pytest.raises(FitError, match="without drive gains"):
        model.stream(LOAD)


# The paper's five methods, by scikit-learn's and statsmodels' numbers

PENALTY = {"tol": 1e-8, "max_iter": 100_000}
THEIRS = {
    "ls": LinearRegression(),
    "ridge": Ridge(alpha=0.001),
    "lasso": Lasso(alpha=0.001, **PENALTY),
    "elastic-net": ElasticNet(alpha=0.001, l1_ratio=0.5, **PENALTY),
}
OPTIONS = [(rows, term) for rows in ("dwells", "samples") for term in (False, True)]


@cache
def paired() -> Dataset:
    return dwelling(60, stiction_nm=2.0, both=True)


@cache
def fitted(**params) -> StaticLinear:
    return StaticLinear(**params).fit(paired(), nominal())


def rows_of(dataset, kind):
    """q and current of one row a dwell, or of all."""
    q, current = dataset["q"], dataset["effort"]
    if kind == "samples":
        return q, current
    return q.reshape(-1, 10, 6).mean(axis=1), current.reshape(-1, 10, 6).mean(axis=1)


def matrix(joint, rows, term):
    """R_j of eq. 20 with its column of ones last, and the current."""
    q, current = rows_of(paired(), rows)
    R = own_regressor(joint, q, current[:, joint])
    return R if term else np.delete(R, -2, axis=1), current[:, joint]


def own_coefficients(model, joint, values=None):
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
        np.testing.assert_allclose(own_coefficients(model, joint), found, rtol=1e-8, atol=1e-8)


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
    np.testing.assert_allclose(own_coefficients(model, joint)[:-1], theirs.coef_ / scale, atol=1e-8)


def repeats_weight(joint):
    """1/variance of the ten samples, shrunk towards the mean as by four more observations would."""
    variance = paired()["effort"][:, joint].reshape(-1, 10).var(axis=1, ddof=1)
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
        np.testing.assert_allclose(
            own_coefficients(model, joint), theirs.params, rtol=1e-8, atol=1e-10
        )


def test_every_pose_counts_once_with_weights_pose() -> None:
    some = paired().select(lambda c: c.approach == 1 or c.pose < 20)
    weighted = StaticLinear(method="wls", weights="pose").fit(some, nominal())
    q, current = rows_of(some, "dwells")
    pose = np.array([c.pose for c in some.conditions])
    weight = np.where(pose < 20, 0.5, 1.0)
    theirs = sm.WLS(
        current[:, 2], own_regressor(2, q, current[:, 2])[:, [0, 1, 2, 4]], weight
    ).fit()
    np.testing.assert_allclose(own_coefficients(weighted, 2), theirs.params, rtol=1e-8)


def test_least_squares_agrees_with_the_estimator_that_solves_jointly() -> None:
    joint = StaticWls(form="paper").fit(paired(), nominal())
    np.testing.assert_allclose(fitted().coefficients_, joint.coefficients_, atol=1e-9)
    assert fitted(form="shared").parameter_names_[:2] == base_names()[:2]


def base_names():
    return base_parameters(nominal(), gravity_only=True).names


def test_shared_form_solves_for_all_joints_at_once() -> None:
    model, means = fitted(form="shared"), [rows_of(paired(), "dwells")][0]
    W = base_parameters(nominal(), gravity_only=True).reduce(nominal().gravity_regressor(means[0]))
    X = np.hstack([W, np.tile(np.eye(6), (len(means[0]), 1))])
    theirs = np.linalg.lstsq(X, (means[1] * GAINS).ravel())[0]
    np.testing.assert_allclose(model.coefficients_, theirs, atol=1e-8)


def test_repeats_weigh_the_joints_of_the_shared_form_in_the_unit_of_their_torques() -> None:
    model = fitted(method="wls", form="shared", weights="repeats")
    in_torque = replace(
        paired(),
        columns={**paired().columns, "effort": paired()["effort"] * np.array(GAINS)},
        effort_kind="torque",
        drive_gains=None,
    )
    same = StaticLinear(method="wls", form="shared", weights="repeats").fit(in_torque, nominal())
    assert model.coefficients_ == pytest.approx(same.coefficients_, rel=1e-6, abs=1e-9)


def test_ridge_of_the_shared_form_leaves_offsets_unpenalised() -> None:
    model, (q, current) = (
        fitted(form="shared", method="ridge", alpha=10.0),
        rows_of(paired(), "dwells"),
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
    assert np.all(own_coefficients(ten, 1, ten.std_error_) > 2 * naive.bse)


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


def test_models_are_labelled_by_what_they_saw() -> None:
    assert fitted().protocol == "honest"
    assert fitted(current_term=True).protocol == PAPER_PROTOCOL
    assert estimator("static-linear", method="ridge").alpha == 0.001


def test_short_dwells_are_used_as_they_are_and_noted() -> None:
    keep = np.ones(len(paired()), dtype=bool)
    keep[3:10] = False
    model = StaticLinear(method="wls", weights="repeats").fit(cut(paired(), keep), nominal())
    assert model.notes_ == (
        "1 of 120 dwells have fewer than 10 samples (the shortest 3); each is used unchanged",
    )
    assert np.all(np.isfinite(model.coefficients_))


def changed(q=None, effort=None) -> Dataset:
    columns = dict(paired().columns)
    columns |= {"q": q} if q is not None else {}
    columns |= {"effort": effort} if effort is not None else {}
    return replace(paired(), columns=columns)


def with_wrist_still():
    q = paired()["q"].copy()
    q[:, 4] = 0.3 + 1e-5 * np.random.default_rng(0).normal(size=len(q))
    return changed(q=q)


def with_gripper_level():
    q = paired()["q"].copy()
    q[:, 3] = 1.0 - q[:, 1] - q[:, 2]
    return changed(q=q)


@pytest.mark.parametrize("method", ["ls", "wls", "ridge", "lasso"])
@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        (with_wrist_still, "wrist_2_joint never moved"),
        (with_gripper_level, "joint3.phi1, joint4.phi1 is the same at every pose"),
    ],
    ids=["still", "constant"],
)
def test_bad_data_end_in_one_clear_error(method, spoiled, message) -> None:
    with pytest.raises(FitError, match=message):
        StaticLinear(method=method).fit(spoiled(), nominal())


def test_axes_that_gravity_does_not_depend_on_may_stand_still() -> None:
    q = paired()["q"].copy()
    q[:, 0] = 0.5
    assert StaticLinear().fit(changed(q=q), nominal()).poses_ == 60
