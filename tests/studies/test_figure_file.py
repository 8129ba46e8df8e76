"""Figures in `study.json`: what is written is read, and older files still are."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from hil.core import DataError, json_document
from hil.studies.figure import (
    Axis,
    Band,
    Curve,
    Figure,
    Grid,
    Look,
    Mark,
    Panel,
    Span,
    Style,
    figure_from_dict,
)
from hil.studies.store import read_study, write_study
from tests.support.study_parts import assert_figures_survive_json, bars, result, six_panels

NAN = math.nan
LOOK = Look("#0072b2", "dash", "diamond", "/", 2.0, 5.0, 0.5)
CURVES = tuple(
    Curve(style, (1.0, 2.0), (NAN, 4.0), style, (0.1, 0.2), LOOK, ("one", "two"))
    for style in get_args(Style)
)
GRID = Grid(np.array([0.0, 1.0]), np.array([2.0]), np.array([[NAN, 0.5]]))
FULL = Panel(
    "J1", "time", "current [A]", CURVES, "R = 1", "Two points.", True, Axis("date", (0.0, 2.0)),
    Axis("log", None, True, True), Band("noise", 0.3), (Mark("2026-01-01", "new", "champion"),),
    (Span(0.0, 1.0, -1),), GRID, True,
)  # fmt: skip


@pytest.mark.parametrize(
    "figure",
    [six_panels(3), bars(), Figure("fig-1", "All", "Each field is set.", (FULL,), 1)],
    ids=lambda figure: figure.key,
)
def test_every_field_survives(figure: Figure) -> None:
    assert_figures_survive_json(result(figure))


def test_a_field_that_is_not_used_takes_no_room() -> None:
    (panel,) = bars().to_dict()["panels"]
    assert set(panel) == {"title", "x_title", "y_title", "curves", "corner"}
    assert {*panel["curves"][0]} == {"name", "x", "y", "style", "y_error"}


def test_a_figure_of_the_first_files_is_read() -> None:
    curve = {"name": "LS", "x": ["J1"], "y": [None], "style": "bars", "y_error": []}
    panel = {"title": "a", "x_title": "b", "y_title": "c", "curves": [curve], "corner": ""}
    raw = {"key": "f", "title": "t", "caption": "", "panels": [panel], "per_row": 1}
    read = figure_from_dict(raw)
    assert json.loads(json_document(read.to_dict())) == raw
    assert read.panels[0].curves[0].look is None


@pytest.mark.parametrize(
    "change", [{"style": "bar"}, {"look": {"dash": "dot"}}, {"look": 3}, {"y": 1.0}]
)
def test_what_is_garbled_is_told(change: dict[str, Any], tmp_path: Path) -> None:
    path = write_study(result(bars()), tmp_path)
    document = json.loads(path.read_bytes())
    document["parts"][0]["figures"][0]["panels"][0]["curves"][0] |= change
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match="damaged"):
        read_study(path)
