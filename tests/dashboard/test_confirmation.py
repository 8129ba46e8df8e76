"""The dashboard moves a real robot only after its name was typed beside the facts of the motion."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from starlette.testclient import TestClient

from hil.core.errors import NotConfirmed, RobotConnectionError
from hil.dashboard import plan_preview, start_page
from hil.robot import Address
from hil.workflow.motion_confirmation import Granted
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.confirming import AT, SPEC
from tests.support.web_parts import dashboard, plain, require_fit_for_all

pytestmark = pytest.mark.usefixtures("plans_once")

STATION = """
hil_station: 1
robots:
  ur5: {driver: mock, model: ur5, checklist: [The emergency stop is within reach.]}
"""


class Desk:
    """A browser at a dashboard that plans in this process and notes what it would start."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (folder / "specs").mkdir()
        self.spec = folder / "specs" / "small.yaml"
        self.spec.write_text(SPEC)
        (folder / "specs" / "station.yaml").write_text(STATION)
        self.browser: TestClient = dashboard(folder)
        self.started: list[dict[str, Any]] = []
        monkeypatch.setattr(start_page, "start_run", self._start)
        monkeypatch.setattr(plan_preview, "plan_in_process", self._plan)
        monkeypatch.setattr(plan_preview, "PICTURES", 0)  # a drawing takes a second

    def _start(self, spec: Path, runs: Path, **more: Any) -> Any:
        self.started.append(more)
        return SimpleNamespace(id=str(len(self.started)))

    async def _plan(self, asked: dict[str, Any], gone: object) -> dict[str, Any]:
        return plan_preview._plan(asked)

    def post(self, do: str, **fields: str) -> Any:
        csrf = self.browser.app.state.settings.csrf  # type: ignore[attr-defined]
        form = {"csrf": csrf, "spec": "small.yaml", "do": do}
        return self.browser.post("/start", data=form | fields, follow_redirects=False)

    def shown(self) -> dict[str, str]:
        """What the form sends back once the plan was shown."""
        html = self.post("check").text
        require_fit_for_all(html)
        return hidden(html)


def hidden(html: str) -> dict[str, str]:
    return dict(re.findall(r'name="(checked|facts)" value="([0-9a-f]{64})"', html))


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(tmp_path, monkeypatch)


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> None:
    """The embedded mock, declared to be a real arm at an address."""
    monkeypatch.setattr(MockRobot, "address", Address(AT))


@pytest.mark.thorough
def test_a_mock_needs_no_confirmation(desk: Desk) -> None:
    html = desk.post("check").text
    assert "to move" not in html
    assert desk.post("start").status_code == 303
    assert desk.started[0]["confirmed"] is None


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_the_form_shows_what_the_console_shows(desk: Desk) -> None:
    told = plain(desk.post("check").text)
    for text in (AT, "1.5 kg at (0, 0, 50) mm", "the robot allows", "duration", "elbow", "flange",
                 "The emergency stop is within reach.", "Type ur5 to move"):  # fmt: skip
        assert text in told


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_without_the_name_nothing_is_started(desk: Desk) -> None:
    shown = desk.shown()
    for typed in ("", "UR5", "ur5e", "yes"):
        answer = desk.post("start", confirm=typed, **shown)
        assert answer.status_code == 409
        assert "ur5 was not confirmed" in plain(answer.text)
        assert "Type ur5 to move" in plain(answer.text)
        assert desk.started == []


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_with_the_name_the_facts_that_were_shown_are_confirmed(desk: Desk) -> None:
    assert desk.post("start", confirm="ur5", operator="ada", **desk.shown()).status_code == 303
    (started,) = desk.started
    assert started["operator"] == "ada"
    facts = started["confirmed"]
    assert (facts["robot"], facts["address"]) == ("ur5", AT)
    assert facts["loads"] == [{"mass_kg": 1.5, "com_m": [0.0, 0.0, 0.05]}]
    assert facts["swept"]["duration_s"] > 0


def write_series(desk: Desk, *robots: str) -> dict[str, str]:
    """Write a series of an experiment for each robot, and return the field that names it."""
    folder = desk.spec.parent
    (folder / "station.yaml").write_text(
        STATION + STATION.rpartition("robots:\n")[2].replace("ur5:", "ur5b:")
    )
    for i, robot in enumerate(robots):
        spec = SPEC.replace("robot: ur5", f"robot: {robot}").replace("name: small", f"name: s{i}")
        (folder / f"s{i}.yaml").write_text(spec.replace("mass_kg: 1.5", f"mass_kg: {1.5 + i}"))
    entries = "".join(f"  - spec: s{i}.yaml\n" for i in range(len(robots)))
    (folder / "both.yaml").write_text(f"hil_series: 1\nname: both\nseries:\n{entries}")
    return {"spec": "both.yaml"}


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_of_a_series_the_facts_of_each_experiment_are_confirmed(desk: Desk) -> None:
    series = write_series(desk, "ur5", "ur5")
    shown = hidden(desk.post("check", **series).text)
    assert desk.post("start", confirm="ur5", **shown, **series).status_code == 303
    facts = desk.started[0]["confirmed"]
    assert (facts["robot"], facts["address"]) == ("ur5", AT)
    motions = {one["experiment"]: one for one in facts["motions"]}
    assert [one["loads"][0]["mass_kg"] for one in motions.values()] == [1.5, 2.5]
    heavy = motions["s1"] | {"loads": [{"mass_kg": 20.0, "com_m": [0.0, 0.0, 0.0]}]}
    granted = Granted("dashboard", "ada", facts)
    granted(as_facts(motions["s1"]), lambda: None)
    with pytest.raises(NotConfirmed, match=r"loads was 2\.5 kg, is 20 kg"):
        granted(as_facts(heavy), lambda: None)


def as_facts(document: dict[str, Any]) -> Any:
    return SimpleNamespace(robot=document["robot"], to_dict=lambda: document)


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_a_series_of_two_robots_is_left_to_the_command_line(desk: Desk) -> None:
    series = write_series(desk, "ur5", "ur5b")
    html = desk.post("check", **series).text
    assert "Type " not in plain(html)
    assert 'name="confirm"' not in html
    for typed in ("", "ur5", "ur5b"):
        answer = desk.post("start", confirm=typed, **hidden(html), **series)
        assert answer.status_code == 409
        assert f"ur5 at {AT} and ur5b at {AT}" in plain(answer.text)
        assert "on the command line: hil run" in plain(answer.text)
    assert desk.started == []


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_what_was_never_shown_confirms_nothing(desk: Desk) -> None:
    for fields in (
        {},
        {"facts": "0" * 64},
        {"facts": "0" * 64, "checked": desk.shown()["checked"]},
    ):
        answer = desk.post("start", confirm="ur5", **fields)
        assert answer.status_code == 409
        assert "Type ur5 to move" in plain(answer.text)
    assert desk.started == []


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_facts_that_have_changed_are_shown_and_not_started(desk: Desk) -> None:
    before = desk.shown()
    desk.spec.write_text(SPEC.replace("mass_kg: 1.5", "mass_kg: 2.5"))
    answer = desk.post("start", confirm="ur5", **before)
    assert answer.status_code == 409
    assert "2.5 kg at" in plain(answer.text)
    assert hidden(answer.text)["facts"] != before["facts"]
    assert desk.started == []


@pytest.mark.thorough
@pytest.mark.usefixtures("real")
def test_a_robot_that_cannot_be_asked_where_it_stands_is_planned_and_not_started(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = plan_preview.preview_experiment

    def off(experiment: Any, *, connect: bool = False) -> Any:
        if connect:
            raise RobotConnectionError("it is switched off", hint="switch it on")
        return planned(experiment)

    monkeypatch.setattr(plan_preview, "preview_experiment", off)
    answer = desk.post("check")
    assert "it is switched off" in plain(answer.text)
    assert "facts" not in hidden(answer.text)
    assert desk.post("start", confirm="ur5", **hidden(answer.text)).status_code == 409
    assert desk.started == []
