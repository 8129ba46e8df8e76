"""`hil optimise`: figures against finite differences and Pinocchio, its table, page and JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from hil import api
from hil.arms import load_arm
from hil.cli.app import app
from hil.core.errors import SpecError
from hil.dynamics import RobotModel, base_parameters
from hil.dynamics.build import model_from_arm
from hil.excitation.motion import FourierSeries
from hil.excitation.quality import Information, jerk_of
from hil.planning.excitation_report import ExcitationReport
from hil.report.excitation_page import excitation_page
from hil.workflow.preview import appraise_excitation

SPEC = """
hil: 1
name: quick
robot: ur5
excitation:
  kind: fourier
  trajectories: 2
  harmonics: 2
  fundamental_hz: 0.2
  {more}
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_CACHE", str(cache))
    monkeypatch.delenv("HIL_STATION", raising=False)


@pytest.fixture(scope="module")
def optimised(cache: Path) -> Path:
    path = cache / "quick.yaml"
    path.write_text(SPEC.format(more="optimise: {starts: 1}"), "utf-8")
    return path


@pytest.fixture(scope="module")
def report(optimised: Path, cache: Path) -> ExcitationReport:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("HIL_CACHE", str(cache))
        return appraise_excitation(api.load(optimised))


def shown(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["optimise", *arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.thorough
def test_jerk_is_the_derivative_of_the_acceleration() -> None:
    rng = np.random.default_rng(0)
    a, b = (tuple(map(tuple, rows)) for rows in rng.standard_normal((2, 3, 4)))
    series = FourierSeries((0.0, 0.0, 0.0), a, b, 0.2)
    fine = series.sample(1e4)
    steps = np.diff(fine.qdd, axis=0) * 1e4
    middle = jerk_of(series, (fine.t[1:] + fine.t[:-1]) / 2)
    np.testing.assert_allclose(steps, middle, rtol=1e-5, atol=1e-5)


@pytest.mark.thorough
def test_condition_numbers_are_those_of_pinocchios_regressor(report: ExcitationReport) -> None:
    model = model_from_arm(load_arm("ur5"))
    data, rows = model.createData(), []
    for trajectory in report.appraisal.trajectories:
        samples = trajectory.samples
        for q, qd, qdd in zip(samples.q, samples.qd, samples.qdd, strict=True):
            body = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
            rows.append(np.hstack([body, np.diag(qdd)]))
    W = np.vstack(rows)[:, base_parameters(RobotModel.from_arm("ur5")).independent]
    jointly = report.appraisal.jointly
    assert jointly.condition_raw == pytest.approx(np.linalg.cond(W), rel=1e-6)
    scaled = np.linalg.cond(W / np.linalg.norm(W, axis=0))
    assert jointly.condition_scaled == pytest.approx(scaled, rel=1e-6)


@pytest.mark.thorough
def test_standard_errors_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    W = rng.standard_normal((200, 4)) * [1.0, 3.0, 0.2, 10.0]
    information = Information(np.linalg.qr(W)[1], ("a", "b", "c", "d"))
    expected = np.sqrt(np.diag(np.linalg.inv(W.T @ W)))
    np.testing.assert_allclose(information.standard_errors, expected, rtol=1e-9)
    lengths = np.linalg.norm(W, axis=0)
    assert information.condition_scaled == pytest.approx(np.linalg.cond(W / lengths))


@pytest.mark.thorough
def test_torque_margins_are_those_of_pinocchio(report: ExcitationReport) -> None:
    arm = load_arm("ur5")
    model = model_from_arm(arm)
    data, peaks = model.createData(), []
    for trajectory in report.appraisal.trajectories:
        samples = trajectory.samples
        for row in zip(samples.q, samples.qd, samples.qdd, strict=True):
            peaks.append(np.abs(pin.rnea(model, data, *row)))
    left = 0.8 * arm.effort_max - np.max(peaks, axis=0)
    np.testing.assert_allclose(report.appraisal.margins["effort_nm"], left, atol=1e-6)


@pytest.mark.thorough
def test_optimised_trajectories_tell_more_than_random_draws(report: ExcitationReport) -> None:
    assert report.random is not None
    ours, theirs = (np.linalg.slogdet(each.jointly.triangle)[1] for each in both(report))
    assert ours > theirs + 5
    ratios = report.standard_errors()
    assert ratios is not None
    assert np.median(list(ratios.values())) > 1.2


def both(report: ExcitationReport) -> tuple[Any, Any]:
    return report.appraisal, report.random


@pytest.mark.thorough
def test_the_table_says_where_they_come_from_and_fits_a_narrow_terminal(
    optimised: Path, report: ExcitationReport, tmp_path: Path
) -> None:
    text = shown(str(optimised), "-o", str(tmp_path / "page.html"))
    assert "2 optimised trajectories, all from the cache" in text
    assert f"{report.appraisal.jointly.condition_scaled:.2f}" in text
    tables = [line for line in text.splitlines() if line.startswith(("1 ", "J", "random  "))]
    assert len(tables) == 8
    assert max(map(len, tables)) <= 60
    assert "<svg" not in text


@pytest.mark.thorough
def test_json_holds_the_motions_and_every_margin(optimised: Path, tmp_path: Path) -> None:
    told = json.loads(shown(str(optimised), "-o", str(tmp_path / "page.html"), "--json"))
    assert [each["series"]["kind"] for each in told["trajectories"]] == ["fourier", "fourier"]
    assert len(told["margins"]["effort_nm"]) == 6
    assert told["margins"]["jerk_rad_s3"] == [None] * 6
    assert told["computed"] == 0
    assert told["closest"]["distance_m"] >= 0.02
    assert Path(told["page"]).is_file()


@pytest.mark.thorough
def test_the_page_shows_every_trajectory_under_its_limits(report: ExcitationReport) -> None:
    page = excitation_page(report)
    assert (page.badge.text, page.badge.mark) == ("within all limits", "pass")
    motions = [section for section in page.sections if section.id.startswith("trajectory")]
    assert len(motions) == 2
    for section in motions:
        (plots,) = section.blocks
        assert [panel.title for panel in plots.panels] == [
            "Position", "Velocity", "Acceleration", "Torque", "Distance",
        ]  # fmt: skip
        for panel in plots.panels:
            assert "limit" in [curve.name for curve in panel.curves]


@pytest.mark.thorough
def test_the_page_says_when_a_limit_is_exceeded(report: ExcitationReport) -> None:
    limits = report.appraisal.limits._replace(velocity=0.5 * report.appraisal.limits.velocity)
    page = excitation_page(replace(report, appraisal=replace(report.appraisal, limits=limits)))
    assert (page.badge.text, page.badge.mark) == ("beyond a limit", "fail")


@pytest.mark.thorough
def test_random_draws_are_appraised_without_comparison(cache: Path, tmp_path: Path) -> None:
    spec = tmp_path / "random.yaml"
    spec.write_text(SPEC.format(more="seed: 3"), "utf-8")
    text = shown(str(spec), "-o", str(tmp_path / "page.html"))
    assert "2 random trajectories" in text
    assert "standard errors" not in text


@pytest.mark.thorough
def test_a_dwell_program_is_sent_elsewhere(tmp_path: Path) -> None:
    spec = tmp_path / "dwell.yaml"
    spec.write_text("hil: 1\nname: d\nrobot: ur5\nexcitation: {kind: dwell}\n", "utf-8")
    with pytest.raises(SpecError, match="no trajectories") as error:
        appraise_excitation(api.load(spec))
    assert "hil plan" in error.value.hint
