"""Friction on the page of a model: over velocity and at rest, against friction that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.estimators.diffnea import RigidDiffnea
from hil.estimators.diffnea_friction import FORMS
from hil.estimators.rigid_irls import RigidIrls
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from hil.report import run_figures as figures
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
    curves = figures.moving(motion, 0)
    low, high = (edge(motion.qd[:, 0]) * DEGREES for edge in (np.min, np.max))
    for curve in curves:
        assert np.min(curve.x) == pytest.approx(low, abs=0.5)
        assert np.max(curve.x) == pytest.approx(high, abs=0.5)
    assert [curve.name for curve in curves].count("± 2 standard errors, at most") == 2


def test_friction_that_is_no_curve_is_drawn_as_its_mean_either_way(seen: Predictions) -> None:
    motion = replace(seen.friction.in_motion, curve=None)
    line = figures.moving(motion, 1)[-1]
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
