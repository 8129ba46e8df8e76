"""Learning curves on a page: what is drawn, and what a damaged model file does to it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.networks.training import Curves, Told
from hil.report import colours
from hil.report.fit_facts import FitFacts
from hil.report.model_sections import model_sections
from hil.report.plotly_figure import figure_json, plotly_of
from hil.report.predictions import Predictions
from hil.report.run_figures import ModelView, learning_curves, learning_panel
from hil.studies.figure import Figure


def trained(validation: tuple[float, ...] = (0.5, 0.2, 0.3)) -> Curves:
    curves = Curves(1.0)
    for epoch, error in enumerate(validation, start=1):
        stage = "joint" if epoch < 3 else "dynamics"
        curves.add(Told(stage, epoch, len(validation), 2 * error, error, 0.0, 1e-3))
    return curves


def fit_with(curves: Any) -> FitFacts:
    held_out = {"joint_names": ["J1"], "unit": "N·m", "total": {"rmse_raw": [1.0]}}
    model = {"fitted": {"curves": curves, "samples": 9}}
    return FitFacts(Path("fit/net-1"), "net", "net", {"held_out": held_out}, model)


def learning_plots(fit: FitFacts) -> Figure | None:
    return learning_curves(ModelView(fit, Predictions(None, None)))


def test_the_curve_begins_with_the_untrained_network_and_marks_what_was_kept() -> None:
    loss, validation, kept = learning_panel(trained()).curves
    assert np.array_equal(loss.y, [1.0, 0.4, 0.6])
    assert np.array_equal(validation.x, [0, 1, 2, 3])
    assert np.array_equal(validation.y, [1.0, 0.5, 0.2, 0.3])
    assert (kept.x[0], kept.y[0]) == (2.0, 0.2)


def test_a_dotted_line_stands_between_stages() -> None:
    (mark,) = learning_panel(trained()).marks
    assert mark.x == 2.5


def test_colours_are_of_the_palette_and_axes_have_titles() -> None:
    figure = plotly_of(learning_panel(trained()))
    assert set(re.findall(r"#[0-9A-Fa-f]{6}", figure_json(figure))) <= set(colours.DARK)
    assert figure["layout"]["yaxis"]["title"]["text"].endswith("[1]")


def test_words_say_which_epoch_was_kept_and_how_long_stages_were() -> None:
    plots = learning_plots(fit_with(trained().to_dict()))
    assert plots is not None
    assert "weights of epoch 2 of 3" in plots.caption
    assert "joint: 2; dynamics: 1" in plots.caption


def test_a_training_that_made_things_worse_says_so() -> None:
    plots = learning_plots(fit_with(trained((2.0, 3.0)).to_dict()))
    assert plots is not None
    assert "None of 2 epochs was better" in plots.caption


def test_the_section_of_a_model_shows_them_and_other_models_have_none() -> None:
    titles = [
        [getattr(block, "title", "") for block in model_sections([fit], {})[1].blocks]
        for fit in (fit_with(trained().to_dict()), fit_with(None))
    ]
    assert "Learning curves" in titles[0]
    assert "Learning curves" not in titles[1]


@pytest.mark.parametrize(
    "damage",
    [
        [],
        "curves",
        {"stages": [["joint", 10**15], ["dynamics", 1]]},
        {"stages": [["joint", -1], ["dynamics", 4]]},
        {"loss": [1.0, None, 2.0]},
        {"validation": [1.0]},
        {"untrained": float("inf")},
    ],
)
def test_damaged_curves_leave_the_page_without_them(damage: Any) -> None:
    whole = json.loads(json.dumps(trained().to_dict()))
    told = whole | damage if isinstance(damage, dict) else damage
    assert learning_plots(fit_with(told)) is None
