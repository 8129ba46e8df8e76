"""The page of drift: every probe with its band, champions marked, causes in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError
from hil.models.drift import ChartedProbe, assess, charted_probes
from hil.models.model_registry import Registry
from hil.report import drift_page as figures
from hil.report.drift_page import drift_page, in_time
from hil.report.plotly_figure import plotly_of
from tests.support.drift_parts import probe

MOTION, FRICTION_J2 = 30, 3


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    """Four quiet probes and two of a robot with more friction."""
    folder = tmp_path_factory.mktemp("drift")
    campaign = hil.fit([probe(folder, 1, noise=1)], estimator="rigid-wls", out=folder)
    made = Registry(folder / "registry")
    made.register("ur5", campaign.fitted.folder, {"effort_kind": "current"})
    made.promote("ur5", 1, reason="the first", evidence={}, instead_of=0)
    for noise in range(4):
        assess(made, "ur5", probe(folder, MOTION, noise=noise))
    for noise in (9, 10):
        assess(made, "ur5", probe(folder, MOTION, noise=noise, more_friction=0.15))
    return made


@pytest.fixture(scope="module")
def told(registry: Registry) -> list[ChartedProbe]:
    return charted_probes(registry, "ur5")


@pytest.mark.thorough
def test_bands_are_those_the_probes_were_judged_by(told) -> None:
    assert [one.chart.reference for one in told] == [one.probe.reference for one in told]
    for one in told:
        assert bool(one.chart.alarm.any()) == one.probe.changed
        assert float(np.min(np.minimum(one.chart.p, one.chart.p_mean))) == one.probe.p


@pytest.mark.parametrize(("times", "changed"), [(0.99, True), (1.01, False)])
def test_a_probe_is_called_changed_where_its_chance_falls_below_the_rate(
    told, times, changed
) -> None:
    # Half the rate, shared by all features: what either chart may use up.
    p = times * 0.01 / 2 / len(told[0].probe.features.names)
    one = ChartedProbe(replace(told[0].probe, p=p, false_alarm=0.01), told[0].chart)
    assert (one.chance < 0.01) == changed


def test_a_changed_feature_lies_outside_its_band_and_is_marked(told) -> None:
    _, along = in_time(told, ())
    panel = figures.over_time(told, FRICTION_J2, along, "A")
    bars, quiet, changed = panel.curves
    assert changed.x == [5.0, 6.0]
    assert changed.y[0] > bars.y[4] + bars.y_error[4]
    assert quiet.x == [1.0, 2.0, 3.0, 4.0]
    assert "2 outside" in panel.alt
    other = figures.over_time(told, 0, along, "A")
    assert len(other.curves) == 2, "nobody blames the first joint"


def test_without_times_probes_stand_by_their_number(told) -> None:
    _, along = in_time(told, ())
    assert (along.x, along.changes) == ((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), ((0.5, "v1"),))
    assert along.place(2) == "probe 3"


def test_names_of_champions_stand_above_the_probes_that_are_sure_to_be_unchanged(told) -> None:
    axis = plotly_of(figures.chances(told, in_time(told, ())[1]))["layout"]["yaxis"]
    bottom, top = axis["range"]
    assert 0.12 < top / (top - bottom) < 0.25
    assert top < axis["dtick"], "no number stands where no probability is"


def test_the_page_says_what_changed_and_why_who_is_champion(registry) -> None:
    page = drift_page(registry, "ur5")
    assert page.badge.text == "changed"
    assert page.summary.startswith("Friction up on shoulder_lift_joint: +")
    titles = [section.title for section in page.sections]
    assert titles == ["Probes", "Friction", "Temperature", "Gain", "Offset", "Load", "Champions"]
    champions = page.sections[-1].blocks[0]
    assert champions.kind == "table"
    assert [cell.text for cell in champions.rows[-1][1:4]] == [
        "v1", "promoted to champion", "the first",
    ]  # fmt: skip


def test_at_the_command_line(registry, tmp_path: Path) -> None:
    page = tmp_path / "drift.html"
    where = ["--registry", str(registry.root), "--page", str(page)]
    done = CliRunner().invoke(app, ["drift", "ur5", *where])
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1] == f"page: {page}"
    assert json.loads(CliRunner().invoke(app, ["drift", "ur5", *where, "--json"]).stdout)
    assert "friction up on shoulder_lift_joint" in page.read_text("utf-8")


def test_without_probes_there_is_no_page(registry, tmp_path: Path) -> None:
    empty = Registry(tmp_path / "registry")
    empty.register("ur5", registry.version("ur5").folder, {})
    with pytest.raises(DataError, match="no probes of ur5"):
        drift_page(empty, "ur5")
