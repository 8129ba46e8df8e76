"""Friction on the page of a model: what it draws and says, and what it must not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hil.data.dataset import PREPARED, Dataset
from hil.data.prediction import Prediction
from hil.estimators.diffnea import RigidDiffnea
from hil.estimators.diffnea_friction import FORMS
from hil.estimators.rigid_irls import RigidIrls
from hil.estimators.rigid_linear import RigidLeastSquares, RigidWls
from hil.estimators.static_model import StaticWls
from hil.report import model_figures as figures
from hil.report.page import Page, page_html
from hil.report.predictions import Predictions, predict_with
from hil.report.run_report import run_page
from hil.spec.load import load_spec
from hil.studies.figure import Figure
from hil.workflow.judging import judge_run
from tests.support.report_html import Page as Html
from tests.support.report_runs import dwell_plan, fourier_plan, write_run
from tests.support.synthetic_motion import (
    COULOMB,
    OFFSET,
    SIGN_WIDTH,
    VISCOUS,
    dwelling,
    moving,
    nominal,
)

# Friction on the page of a model: over velocity and at rest, against friction that is known


VELOCITIES = np.linspace(-1.5, 1.5, 31)[:, None] * np.ones(6)
DEGREES = 180 / np.pi
COUNTS = {"samples": 1, "gaps": 0, "missing": 0, "duplicates": 0}


def truth(qd: np.ndarray) -> np.ndarray:
    return COULOMB * np.tanh(qd / SIGN_WIDTH) + VISCOUS * qd + OFFSET


@pytest.fixture(scope="module")
def wls() -> RigidWls:
    return RigidWls().fit(moving(1, 2, 3, noise_a=0.05), nominal())


@pytest.fixture(scope="module")
def seen(wls: RigidWls) -> Predictions:
    return predict_with(wls, moving(4, noise_a=0.05))


def page_of(root, plan) -> Page:
    run = write_run(root, plan)
    judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS)
    return run_page(run.path)


def plots_of(page: Page, title: str) -> Figure:
    blocks = (block for section in page.sections for block in section.blocks)
    return next(block for block in blocks if isinstance(block, Figure) and block.title == title)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "model",
    [RigidWls(), RigidIrls(exponent=False), RigidDiffnea(friction="coulomb-viscous")],
    ids=["wls", "irls", "diffnea"],
)
def test_the_curve_is_the_friction_there_is(model) -> None:
    curve = model.fit(moving(1, 2, 3), nominal()).friction_curve(VELOCITIES)
    assert curve.torque == pytest.approx(truth(VELOCITIES), abs=0.05)
    assert curve.dry == pytest.approx(truth(VELOCITIES) - VISCOUS * VELOCITIES, abs=0.05)


def test_its_standard_error_covers_it_and_grows_with_the_noise(wls: RigidWls) -> None:
    curve = wls.friction_curve(VELOCITIES)
    apart = np.abs(curve.torque - truth(VELOCITIES)) / curve.std_error
    assert np.sqrt(np.mean(apart**2)) < 1.2
    assert (apart < 4).all()
    quiet = RigidWls().fit(moving(1, 2, 3, noise_a=0.01), nominal()).friction_curve(VELOCITIES)
    assert np.median(curve.std_error / quiet.std_error) == pytest.approx(5, rel=0.3)


def test_shapes_add_to_the_standard_error_and_memory_is_no_curve() -> None:
    bent = RigidDiffnea(friction="stribeck").fit(moving(1, 2, 3, noise_a=0.05), nominal())
    still = RigidDiffnea(friction="stribeck")
    still.__dict__.update(bent.__dict__)
    still.std_error_ = bent.std_error_.copy()
    still.std_error_[-6:] = 0.0  # of the Stribeck velocities
    with_shapes, without = (m.friction_curve(VELOCITIES / 10) for m in (bent, still))
    assert (with_shapes.std_error > without.std_error).any()
    bent._arm = replace(bent._arm, form=FORMS["memory"])
    assert bent.friction_curve(VELOCITIES) is None


def test_samples_lie_where_friction_is_known_to_be(seen: Predictions) -> None:
    motion = seen.friction.in_motion
    assert seen.friction.unit == "N·m"
    error = motion.measured - truth(motion.qd)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.05 * 8.5, rel=0.15)  # noise times gain


def test_nothing_is_drawn_beyond_the_velocities_of_the_data(seen: Predictions) -> None:
    motion = seen.friction.in_motion
    curves = figures.friction_in_motion_curves(motion, 0)
    low, high = (edge(motion.qd[:, 0]) * DEGREES for edge in (np.min, np.max))
    for curve in curves:
        assert np.min(curve.x) == pytest.approx(low, abs=0.5)
        assert np.max(curve.x) == pytest.approx(high, abs=0.5)
    assert [curve.name for curve in curves].count("± 2 standard errors (upper bound)") == 2


def test_friction_that_is_no_curve_is_drawn_as_its_mean_either_way(seen: Predictions) -> None:
    motion = replace(seen.friction.in_motion, curve=None)
    line = figures.friction_in_motion_curves(motion, 1)[-1]
    assert line.name == "friction of the model, mean"
    known = truth(np.repeat(line.x[:, None] / DEGREES, 6, axis=1))[:, 1]
    assert (np.diff(line.x) > 0).all()
    fast = np.abs(line.x) > 5
    assert line.y[fast] == pytest.approx(known[fast], abs=0.6)


def test_friction_at_rest_is_what_gravity_leaves_either_side() -> None:
    model = StaticWls().fit(dwelling(60, both=True, stiction_nm=2.0), nominal())
    rest = predict_with(model, dwelling(20, seed=9, both=True, stiction_nm=2.0)).friction.at_rest
    assert rest.predicted is None
    for sign in (1, -1):
        assert rest.measured[rest.approach == sign] == pytest.approx(2.0 * sign, abs=0.2)


def test_models_without_friction_or_by_a_papers_protocol_have_none_to_show() -> None:
    data = dwelling(40, both=True, stiction_nm=2.0)
    paper = StaticWls(form="paper", current_term=True).fit(data, nominal())
    assert predict_with(paper, data).friction.at_rest is None
    static = StaticWls().fit(data, nominal())
    assert predict_with(static, moving(1)).friction.in_motion is None


def test_dwells_of_unknown_approach_tell_nothing_about_friction() -> None:
    data = dwelling(40, both=True)
    unknown = replace(data, conditions=tuple(replace(each, approach=0) for each in data.conditions))
    model = StaticWls().fit(data, nominal())
    assert predict_with(model, unknown).friction.at_rest is None


@pytest.mark.thorough
def test_both_stand_on_the_pages_and_are_said_in_words(tmp_path) -> None:
    rest = plots_of(page := page_of(tmp_path / "d", dwell_plan()), figures.AT_REST)
    assert len(rest.panels) == 6
    html = page_html(page)
    assert Html(html).text.count(figures.AT_REST)
    assert "mean from below" in html
    assert "from above" in rest.panels[0].alt
    motion = plots_of(page_of(tmp_path / "f", fourier_plan()), figures.IN_MOTION)
    assert all("°/s; residual RMS" in panel.alt for panel in motion.panels)
    assert {(panel.x_title, panel.y_title) for panel in motion.panels} == {
        ("velocity [°/s]", "friction [N·m]")
    }


# Friction on the page of a model: what it must not say or draw


def drawn_of(model, data: Dataset, prediction: Prediction) -> Predictions:
    """What is drawn of a model that predicts this."""
    return predict_with(model, data, SimpleNamespace(predict=lambda model, data: prediction))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("model", "holds"),
    [
        (RigidLeastSquares(), True),
        (RigidIrls(exponent=False, feasible=False), True),
        (RigidIrls(exponent=True, feasible=False), False),
    ],
    ids=["wls", "irls", "irls-exponent"],
)
def test_no_band_where_the_standard_errors_of_least_squares_are_not_the_methods(
    model, holds: bool
) -> None:
    model.fit(moving(1, 2, 3, noise_a=0.05), nominal())
    assert np.isfinite(model.friction_curve(VELOCITIES).std_error).all() == holds
    motion = predict_with(model, moving(4, noise_a=0.05)).friction.in_motion
    names = [curve.name for curve in figures.friction_in_motion_curves(motion, 0)]
    assert ("± 2 standard errors (upper bound)" in names) == holds


def test_friction_that_only_the_network_knows_is_not_taken_away(wls: RigidWls) -> None:
    data = moving(4)
    physics = wls.predict(data)
    missed = 0.4 * physics.components["friction"]
    data = data.with_columns(effort=data["effort"] + missed)
    parts = {**physics.components, "residual": missed}
    network = Prediction(physics.effort + missed, physics.std, physics.valid, parts)
    drawn, alone = (drawn_of(wls, data, each).friction.in_motion for each in (network, physics))
    truth = 1.4 * physics.components["friction"] * wls.torque_scale_
    assert drawn.measured == pytest.approx(truth, abs=0.3)
    assert drawn.measured == pytest.approx(alone.measured)
    assert drawn.predicted == pytest.approx(truth)
    assert alone.curve is not None
    assert drawn.curve is None
    said = "The output of the model's network counts as friction"
    assert [said in figures._how_to_read(each) for each in (drawn, alone)] == [True, False]


def test_at_rest_neither() -> None:
    data = dwelling(20, seed=9, both=True, stiction_nm=2.0)
    model = StaticWls().fit(dwelling(60, both=True, stiction_nm=2.0), nominal())
    physics = model.predict(data)
    approach = np.array([each.approach for each in data.conditions])[data.series_index()]
    missed = 2.0 * approach[:, None] / model.torque_scale_
    effort = physics.effort + missed
    parts = {**physics.components, "residual": missed}
    rest = drawn_of(
        model, data, Prediction(effort, physics.std, physics.valid, parts)
    ).friction.at_rest
    assert rest.measured == pytest.approx(
        np.array(rest.approach)[:, None] * np.full(6, 2.0), abs=0.2
    )
    assert rest.predicted is None
    parts["friction"] = np.zeros_like(missed)
    rest = drawn_of(
        model, data, Prediction(effort, physics.std, physics.valid, parts)
    ).friction.at_rest
    assert np.abs(rest.predicted) == pytest.approx(2.0)


def test_dwells_a_model_does_not_hold_for_are_left_out() -> None:
    data = dwelling(20, seed=9, both=True, stiction_nm=2.0)
    model = StaticWls().fit(dwelling(60, both=True, stiction_nm=2.0), nominal())
    physics, number = model.predict(data), data.series_index()
    approach = np.array([each.approach for each in data.conditions])
    # The second joint holds in every other dwell, the third nowhere.
    valid = np.ones_like(physics.valid)
    valid[number % 4 < 2, 1] = valid[:, 2] = False
    # In half the rows of the others, not: they do not count.
    valid[np.arange(len(data)) % 2 == 0] = False
    known = np.where(valid, 2.0 * approach[number, None] / model.torque_scale_, 0.0)
    parts = {**physics.components, "friction": known}
    told = Prediction(physics.effort + known, physics.std, valid, parts)
    rest = drawn_of(model, data, told).friction.at_rest
    held = np.arange(len(approach)) % 4 >= 2
    assert np.array_equal(np.isfinite(rest.predicted[:, 1]), held)
    assert np.array_equal(np.isfinite(rest.measured[:, 1]), held)
    assert rest.predicted[held, 1] == pytest.approx(2.0 * approach[held])
    assert rest.measured[:, 0] == pytest.approx(2.0 * approach, abs=0.2)
    marks = figures.friction_at_rest_curves(rest, 1)
    assert all(np.isfinite(curve.y).all() and len(curve.y) for curve in marks)
    assert figures._mean_sides(rest, 1, "N·m").count("(model 2.00)") == 1
    assert figures._mean_sides(rest, 1, "N·m").count("(model -2.00)") == 1
    assert figures._mean_sides(rest, 2, "N·m") == "mean unknown"
    nowhere = Prediction(told.effort, told.std, np.zeros_like(valid), parts)
    assert drawn_of(model, data, nowhere).friction.at_rest is None


def without(data: Dataset, *names: str) -> Dataset:
    return replace(data, columns={k: v for k, v in data.columns.items() if k not in names})


@pytest.mark.parametrize("prepared", [True, False])
def test_without_a_recorded_velocity_axes_do_not_run_across_the_borders_of_series(
    wls: RigidWls, prepared: bool
) -> None:
    data = moving(4, 5)
    k = data.offsets[1]
    t = data["t"].copy()
    t[k:] += t[k - 1] + 1e-4 - t[k]  # the second file begins right after the first
    bare = without(data.with_columns(t=t), "qd", *(() if prepared else PREPARED))
    seen = predict_with(wls, bare)
    assert seen.motions.qd == pytest.approx(data["qd"], abs=1e-9 if prepared else 0.05)
    motion = seen.friction.in_motion
    assert motion.law_qd[0] == pytest.approx(data["qd"].min(axis=0), abs=0.05)
    assert motion.law_qd[-1] == pytest.approx(data["qd"].max(axis=0), abs=0.05)


def test_of_a_model_without_filters_it_is_the_slope_of_each_series() -> None:
    data = without(moving(4, 5), "qd", *PREPARED)
    t = data["t"].copy()
    t[data.offsets[1] + 5] = t[data.offsets[1] + 4]  # the second cannot be differentiated
    model = StaticWls().fit(dwelling(60, both=True), nominal())
    found = predict_with(model, data.with_columns(t=t)).motions.qd
    assert found[: data.offsets[1]] == pytest.approx(moving(4)["qd"], abs=0.05)
    assert np.isnan(found[data.offsets[1] :]).all()


def test_the_line_goes_no_further_than_the_rows_a_model_holds_for(wls: RigidWls) -> None:
    data = moving(4)
    told, slow = wls.predict(data), np.abs(data["qd"]) < 0.2
    slow[:, 2] = False
    valid = Prediction(told.effort, told.std, slow, told.components)
    motion = drawn_of(wls, data, valid).friction.in_motion
    assert np.nanmax(np.abs(motion.law_qd)) <= 0.2
    assert np.isnan(motion.law_qd[:, 2]).all()
    assert np.isfinite(motion.curve.torque[:, [0, 1, 3, 4, 5]]).all()
    assert "model unknown" in figures._ends(
        motion, figures.friction_in_motion_curves(motion, 2)[-1], 2, "N·m"
    )


def test_what_is_said_of_the_line_is_of_the_terms_it_has(seen: Predictions) -> None:
    coulomb = figures._how_to_read(seen.friction.in_motion)
    assert "half its step at zero is Coulomb friction" in coulomb
    assert "the middle of the step is the offset" in coulomb
    assert "static friction" not in coulomb
    bent = RigidDiffnea().fit(moving(1, 2, 3, noise_a=0.05), nominal())
    stribeck = figures._how_to_read(predict_with(bent, moving(4)).friction.in_motion)
    assert "half its step at zero is static friction" in stribeck
    assert "is Coulomb friction" not in stribeck
    law = replace(seen.friction.in_motion.curve, terms=("coulomb",))
    bare = figures._how_to_read(replace(seen.friction.in_motion, curve=law))
    assert "offset" not in bare
    assert "viscous" not in bare


def test_a_band_is_told_of_where_one_is_drawn(seen: Predictions) -> None:
    motion = seen.friction.in_motion
    unsure = replace(motion.curve, std_error=np.full_like(motion.curve.torque, np.nan))
    for law, drawn in ((motion.curve, True), (unsure, False)):
        told = figures._how_to_read(replace(motion, curve=law))
        assert ("is therefore an upper bound" in told) == drawn
        assert ("No band is drawn" in told) != drawn


def test_friction_that_is_not_told_as_a_curve_is_not_said_to_depend_on_more(
    seen: Predictions,
) -> None:
    told = figures._how_to_read(replace(seen.friction.in_motion, curve=None))
    assert "depends" not in told
    assert "the mean friction of the model at each velocity" in told


def test_a_gain_of_one_with_a_source_is_known() -> None:
    data = dwelling(60, both=True)
    gains = {"drive_gains": np.ones(6), "drive_gains_source": "calibrated"}
    known = StaticWls().fit(replace(data, **gains), nominal())
    assert predict_with(known, dwelling(20, seed=9, both=True)).friction.unit == "N·m"


def test_the_worst_trajectory_is_that_of_the_largest_error_where_the_model_is_valid(
    wls: RigidWls,
) -> None:
    data = moving(4, 5)
    said = wls.predict(data)
    first = data.series_index()[:, None] == 0
    effort = data["effort"] + np.where(first, 1.0, 0.5)
    valid = ~first | (np.arange(len(data)) % 10 == 0)[:, None]
    seen = drawn_of(wls, data, Prediction(effort, said.std, valid & said.valid, said.components))
    assert seen.motions.worst == data.conditions[0]
