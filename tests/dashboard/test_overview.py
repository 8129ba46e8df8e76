"""The overview: short with a hundred robots, and honest about what is a run."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from hil.core.lock_file import hold_run
from hil.recording.run_directory import RunDirectory
from hil.robot.lease import leased
from tests.support.browser.bench import opened, serving
from tests.support.browser.looking import problems_of, tab_to, until
from tests.support.web_parts import dashboard, plain, seen

MANY = 40


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two stations, one of many robots."""
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    (tmp_path / "specs").mkdir()
    for name, count in (("many", MANY), ("few", 3)):
        robots = "".join(f"  {name}-{i:02d}: {{driver: mock, model: ur5}}\n" for i in range(count))
        text = f"hil_station: 1\nname: {name}\nrobots:\n{robots}"
        (tmp_path / "specs" / f"{name}.yaml").write_text(text)
    return tmp_path


def card(html: str, station: str) -> tuple[str, str]:
    """What of a station is always seen, and what only behind its summary."""
    (found,) = [one for one in html.split("<article") if f"<h3>{station} <small>" in one]
    always, _, rest = found.split("</article>")[0].partition("<details")
    return always, rest


def test_of_many_robots_those_that_are_held_are_seen_and_the_rest_is_counted(lab: Path) -> None:
    station = str(lab / "specs" / "many.yaml")
    robot: Any = SimpleNamespace(resource="many-07")
    with leased(robot, name="many-07", driver="mock", station=station):
        always, rest = card(seen(dashboard(lab), "/"), "many")
    assert re.findall(r"<li>([\w-]+)", always) == ["many-07"]
    assert f"{MANY} robots, 1 held" in plain(always)
    assert f"{MANY - 1} not held" in plain(rest).split(">")[-1]
    assert len(re.findall("<li>", rest)) == MANY - 1
    assert not re.match("[^>]* open", rest)


def test_of_few_robots_all_are_seen(lab: Path) -> None:
    always, rest = card(seen(dashboard(lab), "/"), "few")
    assert re.findall(r"<li>([\w-]+)", always) == ["few-00", "few-01", "few-02"]
    assert rest == ""


def test_stations_of_the_same_name_are_told_apart_by_their_headings(lab: Path) -> None:
    text = (lab / "specs" / "few.yaml").read_text()
    (lab / "specs" / "copy.yaml").write_text(text)
    headings = re.findall(r"<h3>few <small>\((.*?)\)</small></h3>", seen(dashboard(lab), "/"))
    assert [Path(source).name for source in headings] == ["copy.yaml", "few.yaml"]


def test_folders_of_simulations_and_fleets_are_no_runs(lab: Path) -> None:
    for folder in ("simulations/simulation-weekly", "fleet/fleet-small", "series/two"):
        (lab / "runs" / "2026-11-22" / folder).mkdir(parents=True)
    RunDirectory.create(lab / "runs", "ur5", "dwell")
    html = seen(dashboard(lab), "/")
    assert re.findall(r'scope="row"><a href="/runs/[^"]*/([\w-]+)"', html) == ["0001-dwell"]


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_what_was_opened_by_keys_stays_open_when_a_run_begins(lab: Path) -> None:
    with serving(lab, "--specs", "specs") as address, opened() as browser:
        page = browser.new_page()
        said = problems_of(page)
        page.goto(address)
        tab_to(page, "summary")
        page.keyboard.press("Enter")
        assert page.is_visible("text=many-39")
        page.evaluate("document.activeElement.blur()")
        run = RunDirectory.create(lab / "runs", "ur5", "dwell")
        with hold_run(run.path):
            run.write_start({"uid": "u"})
            until(page, "document.querySelector('[data-card]') !== null", 20)
            assert page.is_visible("text=many-39")
        assert said == []
