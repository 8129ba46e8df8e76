"""Figures of pages: units, samples that are left out, colours."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.core.typing import FloatArray
from hil.data import Conditions
from hil.report import colours, figure_list, model_figures, run_figures
from hil.report.colours import PALETTE
from hil.report.curves import binned, decimated, extremes, has_names, summarised, thinned
from hil.report.figure_list import FIGURES, figures_of
from hil.report.matplotlib_figure import THEME, drawn, following_the_screen
from hil.report.model_figures import ModelView
from hil.report.plotly_figure import figure_json, panel_of, plotly_of
from hil.report.predictions import MotionPredictions
from hil.report.run_figures import RunView
from hil.studies.figure import Curve, Figure, Panel
from tests.support.panels import NAMES, PANELS, A, B, T, panel
from tests.support.report_html import array_of

# Figure builders: units on every axis, every sample counted, nothing that breaks out of JSON


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


@pytest.mark.parametrize(
    ("x", "named"),
    [
        (np.arange(3), False), (np.arange(3.0), False), ((1.0, 2), False), ((), False),
        (("J1", "J2"), True), (np.array(["J1", "J2"]), True), (np.array([1, "J2"], object), True),
    ],
)  # fmt: skip
def test_names_along_x_are_not_taken_for_numbers(x, named):
    assert has_names(Curve("a", x)) is named


def test_a_figure_is_added_by_one_registered_function(monkeypatch):
    monkeypatch.setitem(FIGURES, "model", list(FIGURES["model"]))

    @figure_list.figure("model")
    def nothing_new(view):
        return Figure("new", "Something new", "", ())

    view = ModelView(None, model_figures.Predictions(None, None))
    monkeypatch.setitem(FIGURES, "model", [m for m in FIGURES["model"] if "learn" not in str(m)])
    assert [made.title for made in figures_of("model", view)] == ["Something new"]
    assert RunView.__slots__[:2] == ("facts", "recording")


def test_arrays_travel_as_float32_and_come_back():
    curve = run_figures.joint_curves(T, A[:, None], ["one"])
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
    z = run_figures.counted_grid(np.append(A, np.nan), np.append(B, 1.0)).log_count
    assert round(float(np.nansum(10.0**z))) == 3000


def test_coverage_is_counted_on_so_many_rows_at_most(monkeypatch):
    monkeypatch.setattr(run_figures, "COVERAGE_ROWS", 60)
    grid = run_figures.position_velocity_coverage(run_of(119, joints=2)).panels[0].grid
    assert round(float(np.nansum(10.0**grid.log_count))) == 60


@pytest.mark.parametrize(
    ("joints", "pairs"),
    [(2, ["J1 and J2"]), (3, ["J1 and J2", "J2 and J3"]), (4, ["J1 and J2", "J3 and J4"])],
)
def test_the_pose_map_pairs_every_joint_with_another(joints, pairs):
    made = run_figures.pose_map(run_of(12, joints))
    assert [panel.title for panel in made.panels] == pairs


def run_of(samples: int, joints: int) -> RunView:
    """A run whose every sample is a dwell of its own."""
    rows = np.zeros(
        samples, [("q", float, (joints,)), ("qd", float, (joints,)), ("segment", np.int32)]
    )
    rows["q"] = rows["qd"] = np.linspace(-1.0, 1.0, samples)[:, None]
    rows["segment"] = np.arange(samples)
    facts = SimpleNamespace(
        indices=lambda kind: list(range(samples)) if kind == "dwell" else [],
        steps=[{"pose": k} for k in range(samples)],
        unsettled=[],
        judged_fits=(),
    )
    return RunView(facts, SimpleNamespace(rows=rows), None, [f"joint_{j}" for j in range(joints)])


def test_the_worst_trajectory_is_described_by_its_own_residual():
    t, one = np.arange(3.0), np.ones((3, 1))
    motions = MotionPredictions(
        Conditions("b", "trajectory", "run"), t, 2.0 * one, 0.0 * one, q=np.zeros((6, 1)),
        qd=np.zeros((6, 1)), all_measured=np.vstack([0.0 * one, 2.0 * one]),
        all_predicted=np.zeros((6, 1)), count=2,
    )  # fmt: skip
    fit = SimpleNamespace(
        unit="A", joint_names=["j"], fast_part="noise", values=lambda key: np.zeros(1)
    )
    view = ModelView(fit, model_figures.Predictions(None, motions))
    for make, rms in (
        (model_figures.trajectory_compared, "2.00"),
        (model_figures.trajectory_residual_over_time, "2.00"),
        (model_figures.residual_over_velocity, "1.41"),
    ):
        (drawn,) = make(view).panels
        assert drawn.alt.endswith(f"residual RMS {rms} A")


def test_regression_states_the_correlation():
    pytest.importorskip("scipy.stats")
    from scipy.stats import pearsonr

    predicted = A + 0.5 * B
    _, text = model_figures.regression_curves(A, predicted)
    assert text == f"R = {pearsonr(A, predicted).statistic:.4f}"


def test_regression_of_a_constant_prediction_says_that_r_is_undefined():
    assert model_figures.regression_curves(A, np.ones_like(A))[1] == "R undefined"


def test_dwells_stand_in_the_order_of_the_prediction_and_keep_their_side():
    below, above, predicted = model_figures.dwell_curves(
        np.array([1.1, 3.1, 2.1]), np.array([1.0, 3.0, 2.0]), np.array([1, -1, 1]),
        np.array([7, 8, 9]),
    )  # fmt: skip
    assert (below.x.tolist(), below.y.tolist()) == ([1, 2], [1.1, 2.1])
    assert (above.x.tolist(), above.hover) == ([3], ["pose 8"])
    assert predicted.y.tolist() == [1, 2, 3]


def test_a_joint_that_was_not_measured_is_left_out():
    values = np.column_stack([A, np.full(3000, np.nan)])
    assert [curve.name for curve in run_figures.joint_curves(T, values, NAMES)] == ["J1 one"]


def test_the_mean_residual_follows_a_trend():
    curves = model_figures.residual_curves(A, 0.5 * A + 0.01 * B)
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


# Fewer points must not hide anything


@given(st.integers(1, 5000), st.integers(0, 2**32 - 1), st.integers(4, 400))
def test_the_extremes_and_both_ends_survive_decimation(n, seed, points):
    values = np.random.default_rng(seed).standard_normal(n)
    rows = extremes(values, points)
    assert len(rows) <= points
    assert np.all(np.diff(rows) > 0)
    assert {0, n - 1, int(values.argmin()), int(values.argmax())} <= set(rows.tolist())


def test_a_single_spike_in_half_a_million_samples_is_still_there():
    y = np.zeros(560_000)
    y[123_457] = 7.0
    x, kept = decimated(np.arange(len(y)) / 125.0, y)
    assert kept.max() == 7.0
    assert x[kept.argmax()] == 123_457 / 125.0


def test_a_gap_of_nan_stays_a_gap_and_nan_hides_no_extreme():
    y = np.sin(np.arange(50_000) / 500.0)
    y[20_000:30_000] = np.nan
    y[100] = 3.0
    y[101] = np.nan
    x, kept = decimated(np.arange(len(y), dtype=float), y, 400)
    assert np.nanmax(kept) == 3.0
    assert np.isnan(kept[(x > 20_500) & (x < 29_500)]).all()


def test_short_lines_are_left_alone():
    y = np.array([3.0, np.nan, 1.0])
    np.testing.assert_array_equal(extremes(y, 4), [0, 1, 2])


def test_thinning_keeps_both_ends_and_spreads_evenly():
    rows = thinned(10_000, 100)
    assert (rows[0], rows[-1], len(rows)) == (0, 9_999, 100)
    assert np.ptp(np.diff(rows)) <= 1


def test_binned_means_and_deviations_are_those_of_scipy():
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-3, 3, 4000), rng.standard_normal(4000)
    centres, mean, spread = binned(x, y, 20)
    expected = stats.binned_statistic(x, y, "mean", 20)
    np.testing.assert_allclose(mean, expected.statistic)
    np.testing.assert_allclose(spread, stats.binned_statistic(x, y, "std", 20).statistic)
    np.testing.assert_allclose(centres, (expected.bin_edges[1:] + expected.bin_edges[:-1]) / 2)


def test_bins_with_hardly_a_sample_are_left_out():
    x = np.concatenate([np.zeros(50), [10.0]])
    assert len(binned(x, x, 10, least=5)[0]) == 1


def test_an_envelope_keeps_the_largest_and_a_trend_the_mean():
    x = np.arange(30_000, dtype=float)
    y = np.abs(np.sin(x))
    y[777] = 9.0
    assert summarised(x, y, "upper")[1].max() == 9.0
    t, mean = summarised(x, y, "mean")
    assert len(t) == 300
    np.testing.assert_allclose(mean[10:], 2 / np.pi, atol=0.05)


# The palette: read on both pages, and told apart with every common form of colour blindness


APART = 15.0
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip
TO_XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                   [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip
WHITE = np.array([0.95047, 1.0, 1.08883])
CSS = files("hil.report").joinpath("report.css").read_text("utf-8")
LIGHT, DARK = (
    dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", part)) for part in CSS.split("@media")[:2]
)
BEHIND = {"pass": "pass-back", "fail": "fail-back", "warn": "warn-back"}
THEMES = {"light": (LIGHT, {c: c for c in colours.DARK}), "dark": (DARK, colours.DARK)}


def linear(colour: str) -> FloatArray:
    """sRGB as linear RGB."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def contrast(a: str, b: str) -> float:
    """Of two colours, as WCAG defines it."""
    low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (a, b))
    return (high + 0.05) / (low + 0.05)


def lab(colour: str, vision: str) -> FloatArray:
    """CIELAB of what is seen."""
    seen = np.clip(np.array(VISION[vision]) @ linear(colour), 0, 1)
    ratio = TO_XYZ @ seen / WHITE
    small = ratio * (29 / 6) ** 2 / 3 + 4 / 29
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), small)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(a: str, b: str, vision: str) -> float:
    """How far two colours are from each other."""
    return float(np.linalg.norm(lab(a, vision) - lab(b, vision)))


def test_measures_are_those_of_the_standards() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)
    assert lab("#ff0000", "normal") == pytest.approx([53.24, 80.09, 67.20], abs=0.05)
    red, green = (lab(c, "deuteranopia") for c in ("#b00000", "#6a6a00"))
    assert np.linalg.norm(red - green) < 0.5 * apart("#b00000", "#6a6a00", "normal")


@pytest.mark.parametrize("theme", THEMES)
def test_lines_and_marks_stand_out_from_the_page(theme: str) -> None:
    css, of = THEMES[theme]
    weak = {c: contrast(of[c], css["page"]) for c in colours.DARK if c != colours.FILL}
    assert {c: x for c, x in weak.items() if x < 3.0} == {}


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("vision", VISION)
def test_colours_that_stand_together_are_told_apart(theme: str, vision: str) -> None:
    of = THEMES[theme][1]
    close = {
        (a, b): round(apart(of[a], of[b], vision), 1)
        for palette in (colours.JOINTS, PALETTE)
        for a, b in combinations(palette, 2)
        if apart(of[a], of[b], vision) < APART
    }
    assert close == {}


@pytest.mark.parametrize("theme", THEMES)
def test_letters_can_be_read(theme: str) -> None:
    css = THEMES[theme][0]
    pairs = [(text, back) for text in ("ink", "muted", "link") for back in ("page", "raised")]
    pairs += [*BEHIND.items(), *((text, "page") for text in BEHIND)]
    pairs += [("ink", back) for back in BEHIND.values()]
    weak = {(a, b): contrast(css[a], css[b]) for a, b in pairs if contrast(css[a], css[b]) < 4.5}
    assert weak == {}
    assert contrast(css["axis"], css["page"]) >= 3.0


@pytest.mark.parametrize("theme", THEMES)
def test_a_picture_speaks_the_same_language(theme: str) -> None:
    of = THEMES[theme][1]
    told = {light: light if theme == "light" else dark for light, (_, dark) in THEME.items()}
    assert {c: told[c.lower()].upper() for c in colours.DARK} == {c: of[c] for c in colours.DARK}
    assert contrast(told["#000000"], told["#ffffff"]) >= 4.5
    weak = {c: contrast(told[c.lower()], told["#ffffff"]) for c in colours.DARK}
    assert {c: x for c, x in weak.items() if x < 3.0 and c != colours.FILL} == {}


def test_joints_differ_in_dash_and_mark_as_well() -> None:
    looks = zip(colours.DASHES[:6], colours.SYMBOLS[:6], strict=True)
    assert len(set(looks)) == len(set(colours.DASHES[:6])) == len(set(colours.SYMBOLS[:6])) == 6
    assert set(colours.DASHES) == set(colours.STROKES)
