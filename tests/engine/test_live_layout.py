"""The layout for viewers: what it shows is what is served, and it has the structure they load.

The structure is that of layouts exported by Foxglove (its SDK ships some as examples): panel
configurations by `Type!id`, and a binary tree of splits whose leaves are those ids.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from hil.engine.live_view import LAYOUT, PROGRESS_SCHEMA, PROGRESS_TOPIC, RobotTopics
from hil.robot import Capabilities

layouts = pytest.importorskip("foxglove.layouts")

DOCUMENT: dict[str, Any] = json.loads(LAYOUT.read_text("utf-8"))
PANELS: dict[str, dict[str, Any]] = DOCUMENT["configById"]
CONFIGS = {
    "Plot": layouts.PlotConfig,
    "StateTransitions": layouts.StateTransitionsConfig,
    "Indicator": layouts.IndicatorConfig,
    "Gauge": layouts.GaugeConfig,
    "RosOut": layouts.LogConfig,  # the log panel has kept its old name
    "RawMessages": layouts.RawMessagesConfig,
}
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}


def leaves(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
        return
    assert set(node) == {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    yield from leaves(node["first"])
    yield from leaves(node["second"])


def paths(value: Any) -> Iterator[str]:
    """Every message path in a panel's configuration: texts that begin with a slash."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from paths(item)
    elif isinstance(value, str) and value.startswith("/"):
        yield value


def test_it_has_the_parts_of_an_exported_layout() -> None:
    assert set(DOCUMENT) == {
        "configById", "globalVariables", "userNodes", "playbackConfig", "layout",
    }  # fmt: skip
    assert DOCUMENT["playbackConfig"] == {"speed": 1}


def test_every_panel_is_in_the_tree_once() -> None:
    found = list(leaves(DOCUMENT["layout"]))
    assert len(found) == len(set(found))
    assert set(found) == set(PANELS)


@pytest.mark.parametrize("panel", PANELS)
def test_panels_are_of_a_known_type_and_say_only_what_it_knows(panel: str) -> None:
    kind, bang, name = panel.partition("!")
    assert bang
    assert name
    known = {*CONFIGS[kind]()._to_dict(), *TITLES}
    assert set(PANELS[panel]) <= known
    for series in PANELS[panel].get("paths", []):
        of = layouts.PlotSeries if kind == "Plot" else layouts.StateTransitionsSeries
        assert set(series) <= set(of()._to_dict())
        assert series["timestampMethod"] == "receiveTime"


@pytest.mark.parametrize("path", sorted({path for p in PANELS.values() for path in paths(p)}))
def test_every_path_leads_to_something_that_is_served(path: str) -> None:
    robot = Capabilities(tuple(f"j{i + 1}" for i in range(6)), 125.0, "current")
    match = re.fullmatch(r"(/[a-z_/]+)(?:\.(\w+))?(?:\[(\d)\])?", path)
    assert match is not None
    topic, field, index = match.groups()
    if topic == PROGRESS_TOPIC:
        assert field is None or field in PROGRESS_SCHEMA["properties"]
        return
    text = RobotTopics(robot).schemas[topic].text
    if field is not None:
        assert re.search(rf"^float64\[6\] {field}\b", text, re.MULTILINE)
        assert 0 <= int(index) < 6
