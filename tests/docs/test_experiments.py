"""experiments/README.md has a line for every experiment, with its robot and station."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from tests.support.paths import EXPERIMENTS

FOLDER = EXPERIMENTS
PAGE = (FOLDER / "README.md").read_text("utf-8")
ROWS = re.findall(r"^\| \[(\w+)\]\(\1\.yaml\) \| .+ \| (.+) \| (.+) \| .+ \|$", PAGE, re.MULTILINE)


def test_every_experiment_has_one_line() -> None:
    assert sorted(name for name, *_ in ROWS) == sorted(file.stem for file in FOLDER.glob("*.yaml"))


def test_robots_and_stations_are_those_of_the_specs() -> None:
    for name, robot, station in ROWS:
        text = (FOLDER / f"{name}.yaml").read_text("utf-8")
        spec = yaml.safe_load(text)
        named = re.findall(rf"run experiments/{name}\.yaml +--station \S+/(\w+)\.yaml", text)
        if "robot" in spec:
            assert (robot, station) == (spec["robot"], named[0] if named else "built-in"), name
        elif "campaign" in spec:
            campaign = yaml.safe_load((FOLDER / spec["campaign"]["spec"]).read_text("utf-8"))
            assert (robot, station) == (campaign["robot"], "built-in"), name
        else:
            assert station == Path(spec["station"]).stem, name


def test_every_station_is_named() -> None:
    for file in (FOLDER / "stations").glob("*.yaml"):
        assert f"(stations/{file.name})" in PAGE or f"| {file.stem} |" in PAGE
