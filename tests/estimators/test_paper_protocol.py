"""Eq. 16–20 of the static paper as printed: the measured current among the inputs, and labelled."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import FitError, SpecError
from hil.estimators import load_model_file, save_model
from hil.estimators.static_model import CURRENT_PART, StaticWls, paper_functions, signed_square
from tests.support.synthetic_motion import GAINS, LOAD, dataset, dwelling, nominal, plant

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


def test_stored_model_keeps_its_label_and_predicts_the_same(data, model, tmp_path) -> None:
    folder = save_model(model, tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    again = load_model_file(folder)
    assert document["fitted"]["protocol"] == again.protocol == model.protocol
    assert np.array_equal(again.predict(data).effort, model.predict(data).effort)


def test_streaming_is_refused_for_want_of_the_current(model) -> None:
    with pytest.raises(FitError, match="needs the measured current to predict the current"):
        model.stream()


def test_torques_have_no_current_term(data) -> None:
    with pytest.raises(FitError, match="needs motor currents, the data hold a torque"):
        paper_model(replace(data, effort_kind="torque", drive_gains=None))


def test_the_term_goes_with_the_papers_form_only() -> None:
    with pytest.raises(SpecError, match="form: paper"):
        StaticWls(current_term=True)


def test_papers_form_is_refused_off_a_level_base(data) -> None:
    from hil.dynamics import load_model

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
