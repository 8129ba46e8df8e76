"""Figure builders: units on every axis, every sample counted, nothing that breaks out of JSON."""

import json
import re

import numpy as np
import pytest

from hil.report import colours
from hil.report import run_figures as figures
from hil.report.curves import dressed
from hil.report.matplotlib_figure import drawn, following_the_screen
from hil.report.plotly_figure import figure_json, panel_of, plotly_of
from hil.report.run_figures import FIGURES, ModelView, RunView, figures_of
from hil.studies.figure import Axis, Band, Curve, Figure, Look, Mark, Panel
from tests.support.report_html import array_of

RNG = np.random.default_rng(0)
T = np.arange(3000) / 125.0
A, B = RNG.standard_normal(3000), RNG.standard_normal(3000)
NAMES = ["one", "two"]
SIDES = np.tile([1, -1, 0], 1000)
BARS = tuple(Curve(n, ("J1", "J2"), tuple(v), "bars") for n, v in (("a", A[:2]), ("b", B[:2])))


def panel(*curves, **more):
    (one,) = dressed(Figure("f", "", "", (Panel("", "x [s]", "y [A]", curves, **more),))).panels
    return one


PANELS = {
    "dwells": panel(*figures.dwell_curves(A, B, SIDES, np.arange(3000))),
    "residual": panel(*figures.residual_curves(A, B), band=Band("noise", 0.1)),
    "regression": panel(*figures.regression_curves(A, B)[0], corner="R = 0.5"),
    "bars": panel(*BARS, Curve("n", ("J1", "J2"), A[:2], "ticks", look=Look(colours.LIMIT))),
    "joints": panel(
        *figures.joint_curves(T, np.column_stack([A, B]), NAMES), figures.limit_line(T[:2], 3.0)
    ),
    "grid": panel(grid=figures.counted_grid(A, B)),
    "powers": panel(Curve("p", T[:9], 10.0 ** -T[:9]), y_axis=Axis("log", (1e-9, 1.0))),
    "dates": panel(
        Curve("d", ("2026-11-22 10:00:00", "2026-11-23 10:00:00"), (1.0, 2.0), "marked"),
        x_axis=Axis("date"),
        marks=(Mark("2026-11-22 12:00:00", "v2", "another champion"),),
    ),
    "ranges": panel(Curve("u", T[:4], A[:4], "ranges", np.ones(4), Look(colours.FILL, size=1))),
    "identity": panel(Curve("c", A[:5], B[:5], "points"), Curve("y = x", style="identity")),
}
"""A panel with every part a description has."""


@pytest.mark.parametrize("name", PANELS)
def test_every_colour_is_of_the_palette_and_has_a_dark_counterpart(name):
    text = figure_json(plotly_of(PANELS[name]))
    assert set(re.findall(r"#[0-9A-Fa-f]{6}", text)) <= set(colours.DARK)


@pytest.mark.parametrize("name", sorted(set(PANELS) - {"identity", "ranges"}))
def test_a_page_gives_back_what_was_described(name):
    was = PANELS[name]
    found = panel_of(json.loads(figure_json(plotly_of(was))), "")
    for here, there in zip(found.curves, was.curves, strict=True):
        assert (here.name, here.style) == (there.name, there.style)
        np.testing.assert_allclose(here.y, np.asarray(there.y), rtol=1e-6)
        assert here.look.colour == there.look.colour
        assert here.style in ("bars", "ticks") or here.look.dash == there.look.dash
    assert (found.x_title, found.y_title, found.corner) == (was.x_title, was.y_title, was.corner)
    assert [(m.x, m.text) for m in found.marks] == [(m.x, m.text) for m in was.marks]
    assert found.y_axis.scale == was.y_axis.scale
    assert (found.band is None) == (was.band is None)


def test_ranges_and_identity_come_back_as_they_are_seen():
    (ranges,) = panel_of(json.loads(figure_json(plotly_of(PANELS["ranges"]))), "").curves
    assert (ranges.style, list(ranges.y_error)) == ("ranges", [1.0] * 4)
    _, line = panel_of(json.loads(figure_json(plotly_of(PANELS["identity"]))), "").curves
    assert list(line.x) == list(line.y)


def test_no_trace_has_more_points_than_a_plot_can_show():
    for name in set(PANELS) - {"dwells"}:
        for trace in plotly_of(PANELS[name])["data"]:
            assert len(trace["x"]) <= 1200


def test_a_figure_is_added_by_one_registered_function(monkeypatch):
    monkeypatch.setitem(FIGURES, "model", list(FIGURES["model"]))

    @figures.figure("model")
    def nothing_new(view):
        return Figure("new", "Something new", "", ())

    view = ModelView(None, figures.Predictions(None, None))
    monkeypatch.setitem(FIGURES, "model", [m for m in FIGURES["model"] if "learn" not in str(m)])
    assert [made.title for made in figures_of("model", view)] == ["Something new"]
    assert RunView.__slots__[:2] == ("facts", "recording")


def test_arrays_travel_as_float32_and_come_back():
    curve = figures.joint_curves(T, A[:, None], ["one"])
    found = json.loads(figure_json(plotly_of(panel(*curve))))["data"][0]
    x, y = array_of(found["x"]), array_of(found["y"])
    assert found["y"]["dtype"] == "f4"
    rows = np.searchsorted(T, x - 1e-4)
    np.testing.assert_allclose(y, A[rows], rtol=1e-6)


def test_a_grid_keeps_its_shape():
    found = json.loads(figure_json(plotly_of(PANELS["grid"])))["data"][0]
    assert array_of(found["z"]).shape == (48, 48)


def test_json_cannot_end_the_script_it_stands_in():
    hostile = "</script><script>alert(1)</script><!-- & \u2028"
    text = figure_json({"name": hostile, "value": float("nan"), "n": np.float64(2.5)})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": hostile, "value": None, "n": 2.5}


def test_names_cannot_become_markup_inside_plotly():
    nasty = "<a href='x'>j</a>"
    drawn = plotly_of(panel(Curve(nasty, (nasty,), (1.0,), "bars", hover=(nasty,)), corner=nasty))
    assert "<" not in str(drawn)


def test_coverage_counts_every_finite_sample():
    z = figures.counted_grid(np.append(A, np.nan), np.append(B, 1.0)).log_count
    assert round(float(np.nansum(10.0**z))) == 3000


def test_regression_states_the_correlation():
    pytest.importorskip("scipy.stats")
    from scipy.stats import pearsonr

    predicted = A + 0.5 * B
    _, text = figures.regression_curves(A, predicted)
    assert text == f"R = {pearsonr(A, predicted).statistic:.4f}"


def test_regression_of_a_constant_prediction_says_that_r_is_undefined():
    assert figures.regression_curves(A, np.ones_like(A))[1] == "R undefined"


def test_dwells_stand_in_the_order_of_the_prediction_and_keep_their_side():
    below, above, predicted = figures.dwell_curves(
        np.array([1.1, 3.1, 2.1]), np.array([1.0, 3.0, 2.0]), np.array([1, -1, 1]),
        np.array([7, 8, 9]),
    )  # fmt: skip
    assert (below.x.tolist(), below.y.tolist()) == ([1, 2], [1.1, 2.1])
    assert (above.x.tolist(), above.hover) == ([3], ["pose 8"])
    assert predicted.y.tolist() == [1, 2, 3]


def test_a_joint_that_was_not_measured_is_left_out():
    values = np.column_stack([A, np.full(3000, np.nan)])
    assert [curve.name for curve in figures.joint_curves(T, values, NAMES)] == ["J1 one"]


def test_the_mean_residual_follows_a_trend():
    curves = figures.residual_curves(A, 0.5 * A + 0.01 * B)
    mean = next(curve for curve in curves if curve.name == "mean")
    np.testing.assert_allclose(mean.y, 0.5 * mean.x, atol=0.1)


def test_printed_lines_of_few_points_keep_their_dashes():
    curves = tuple(Curve(name, np.arange(5.0), np.arange(5.0) + k) for k, name in enumerate("abc"))
    svg = drawn(Figure("key", "three", "", (Panel("", "x", "y", curves),)), "svg").decode()
    assert len(set(re.findall(r"stroke-dasharray: ([^;\"]+)", svg))) >= 2


def test_a_picture_for_the_screen_is_rounded_and_its_texts_are_not():
    svg = b'<svg><text x="1.23456">robot 1.23456</text><path d="M 1.23456 2.0015"/></svg>'
    text = following_the_screen(svg)
    assert "robot 1.23456" in text
    assert 'd="M 1.23 2.00"' in text
