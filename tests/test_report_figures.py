"""Figure builders: units on every axis, every sample counted, nothing that breaks out of JSON."""

import json
import re

import numpy as np
import pytest
from report_html import array_of

from hil.report import colours
from hil.report import plotly_figures as figures
from hil.report.encode import figure_json

RNG = np.random.default_rng(0)
T = np.arange(3000) / 125.0
A, B = RNG.standard_normal(3000), RNG.standard_normal(3000)
NAMES = ["one", "two"]
SIDES = np.tile([1, -1, 0], 1000)

BUILDERS = {
    "measured_predicted": lambda: figures.measured_predicted(T, A, B, "A", "motor current"),
    "dwells": lambda: figures.dwells(A, B, SIDES, np.arange(3000), "A", "motor current"),
    "residual_over": lambda: figures.residual_over(A, B, "velocity [°/s]", "A", 0.1),
    "residual_over_time": lambda: figures.residual_over_time(T, A, "N·m", 0.1),
    "regression": lambda: figures.regression(A, B, "A"),
    "rmse_bars": lambda: figures.rmse_bars(NAMES, {"wls": A[:2]}, ("above 12 Hz", B[:2]), "A"),
    "joints_over_time": lambda: figures.joints_over_time(
        T, np.column_stack([A, B]), NAMES, "temperature [°C]", limit=3.0
    ),
    "over_time": lambda: figures.over_time(T, A, "position [°]"),
    "coverage": lambda: figures.coverage(A, B, "position [°]", "velocity [°/s]"),
    "pose_map": lambda: figures.pose_map(A, B, {"all": np.arange(9)}, "J1 [°]", "J2 [°]"),
}
COUNTED = {"joint", "dwell, in the order of the prediction"}
"""Axes that count things and have no unit."""


@pytest.mark.parametrize("name", BUILDERS)
def test_every_axis_has_a_title_with_a_unit(name):
    layout = BUILDERS[name]()["layout"]
    for axis in ("xaxis", "yaxis"):
        title = layout[axis]["title"]["text"]
        assert title in COUNTED or re.search(r"\[.+\]$", title), title


@pytest.mark.parametrize("name", BUILDERS)
def test_no_trace_has_more_points_than_a_plot_can_show(name):
    for trace in BUILDERS[name]()["data"]:
        assert len(trace["x"]) <= 3000 if name == "dwells" else len(trace["x"]) <= 1200


@pytest.mark.parametrize("name", BUILDERS)
def test_every_colour_is_of_the_palette_and_has_a_dark_counterpart(name):
    text = figure_json(BUILDERS[name]())
    assert set(re.findall(r"#[0-9A-Fa-f]{6}", text)) <= set(colours.DARK)


def test_arrays_travel_as_float32_and_come_back():
    found = json.loads(figure_json(figures.over_time(T, A, "position [°]")))["data"][0]
    x, y = array_of(found["x"]), array_of(found["y"])
    assert found["y"]["dtype"] == "f4"
    rows = np.searchsorted(T, x - 1e-4)
    np.testing.assert_allclose(y, A[rows], rtol=1e-6)


def test_a_grid_keeps_its_shape():
    found = json.loads(figure_json(figures.coverage(A, B, "x [°]", "y [°/s]")))["data"][0]
    assert array_of(found["z"]).shape == (48, 48)


def test_json_cannot_end_the_script_it_stands_in():
    hostile = "</script><script>alert(1)</script><!-- & \u2028"
    text = figure_json({"name": hostile, "value": float("nan"), "n": np.float64(2.5)})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": hostile, "value": None, "n": 2.5}


def test_names_cannot_become_markup_inside_plotly():
    figure = figures.joints_over_time(T, A[:, None], ["<a href='x'>j</a>"], "effort [A]")
    assert figure["data"][0]["name"] == "&lt;a href=&#x27;x&#x27;&gt;j&lt;/a&gt;"


def test_coverage_counts_every_finite_sample():
    x = np.append(A, np.nan)
    y = np.append(B, 1.0)
    z = figures.coverage(x, y, "x [°]", "y [°]")["data"][0]["z"]
    assert round(float(np.nansum(10.0**z))) == 3000


def test_regression_states_the_correlation():
    pytest.importorskip("scipy.stats")
    from scipy.stats import pearsonr

    predicted = A + 0.5 * B
    text = figures.regression(A, predicted, "A")["layout"]["annotations"][0]["text"]
    assert text == f"R = {pearsonr(A, predicted).statistic:.4f}"


def test_regression_of_a_constant_prediction_says_that_r_is_undefined():
    text = figures.regression(A, np.ones_like(A), "A")["layout"]["annotations"][0]["text"]
    assert text == "R undefined"


def test_dwells_stand_in_the_order_of_the_prediction_and_keep_their_side():
    figure = figures.dwells(
        np.array([1.1, 3.1, 2.1]), np.array([1.0, 3.0, 2.0]), np.array([1, -1, 1]),
        np.array([7, 8, 9]), "A", "motor current",
    )  # fmt: skip
    below, above, predicted = figure["data"]
    assert (below["x"].tolist(), below["y"].tolist()) == ([1, 2], [1.1, 2.1])
    assert (above["x"].tolist(), above["text"]) == ([3], ["pose 8"])
    assert predicted["y"].tolist() == [1, 2, 3]


def test_a_joint_that_was_not_measured_is_left_out():
    values = np.column_stack([A, np.full(3000, np.nan)])
    figure = figures.joints_over_time(T, values, NAMES, "temperature [°C]")
    assert [trace["name"] for trace in figure["data"]] == ["one"]


def test_the_mean_residual_follows_a_trend():
    figure = figures.residual_over(A, 0.5 * A + 0.01 * B, "velocity [°/s]", "A")
    mean = next(trace for trace in figure["data"] if trace["name"] == "mean")
    np.testing.assert_allclose(mean["y"], 0.5 * mean["x"], atol=0.1)
