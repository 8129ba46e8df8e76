"""The static estimator on dwells of a UR5 whose gravity is known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import FitError, SpecError
from hil.data import Conditions, Dataset
from hil.estimators.static_model import StaticWls, paper_functions
from tests.support.synthetic_motion import (
    GAINS,
    LOAD,
    OFFSET,
    dwelling,
    fourier,
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
    assert np.array_equal(valid.all(axis=1), slow)
    assert model.predict(dwelling(5)).valid.all()


def test_streaming_equals_predicting() -> None:
    model = StaticWls().fit(dwelling(80), nominal())
    test = dwelling(2, seed=8)
    stream = model.stream()
    still = np.zeros(6)
    steps = [stream.step(q, still, still) for q in test["q"]]
    assert np.array(steps) == pytest.approx(model.predict(test).effort)


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


def test_too_few_dwells_are_refused_with_how_many_are_needed() -> None:
    with pytest.raises(FitError, match="12 dwells are too few: at least"):
        StaticWls().fit(dwelling(12), nominal())


def test_motion_without_stays_is_refused() -> None:
    with pytest.raises(FitError, match="0 dwells are too few"):
        StaticWls().fit(moving(1), nominal())


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
    from hil.dynamics import load_model

    data = dwelling(40)
    two = {name: v if name == "t" else v[:, :2] for name, v in data.columns.items()}
    data = replace(data, columns=two, joint_names=("j0", "j1"), drive_gains=GAINS[:2], robot="two")
    with pytest.raises(FitError, match="six-joint UR arms"):
        StaticWls(form="paper").fit(data, load_model(urdf))


@pytest.mark.parametrize("params", [{"form": "papper"}, {"rest_speed": 0.0}])
def test_parameters_that_cannot_be_are_refused(params) -> None:
    with pytest.raises(SpecError, match=next(iter(params))):
        StaticWls(**params)


def test_motion_used_here_really_moves() -> None:
    _, _, qd, _ = fourier(4)
    assert np.max(np.abs(qd)) > 0.3
