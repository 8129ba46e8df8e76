"""What was checked is what is started: a form carries the digest of its plan."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.dashboard import plan_preview, start_page
from hil.dashboard.plan_preview import experiments_digest
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from tests.support.started_parts import written
from tests.support.web_parts import dashboard

POSES = "0, -90, 90, 0, 0, 0\n10, -80, 80, 0, 0, 0\n"


class Desk:
    """A browser at a dashboard that notes what it would start."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (folder / "specs").mkdir()
        self.spec, self.station = written(folder / "specs")
        self.browser: TestClient = dashboard(folder)
        self.started: list[dict[str, Any]] = []
        monkeypatch.setattr(start_page, "start_run", self._start)

    def _start(self, spec: Path, runs: Path, **more: Any) -> Any:
        self.started.append(more)
        return SimpleNamespace(id=str(len(self.started)))

    def post(self, do: str, **fields: str) -> Any:
        settings = self.browser.app.state.settings  # type: ignore[attr-defined]
        form = {"csrf": settings.csrf, "spec": "asks.yaml", "station": "wall.yaml", "do": do}
        return self.browser.post("/start", data=form | fields, follow_redirects=False)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(tmp_path, monkeypatch)


def checked(html: str) -> str:
    (digest,) = re.findall(r'name="checked" value="([0-9a-f]{64})"', html)
    return str(digest)


@pytest.mark.thorough
def test_what_was_changed_since_it_was_checked_is_shown_anew_and_not_started(desk: Desk) -> None:
    first = checked(desk.post("check").text)
    text, when = desk.spec.read_text(), desk.spec.stat().st_mtime_ns
    desk.spec.write_text(text.replace("waypoints: 12", "waypoints: 13"))
    os.utime(desk.spec, ns=(when, when))
    answer = desk.post("start", checked=first)
    assert answer.status_code == 409
    assert desk.started == []
    assert "not what was checked" in answer.text
    assert re.search(r'<th scope="row">poses</th><td>13</td>', answer.text)
    assert checked(answer.text) != first
    assert desk.post("start", checked=checked(answer.text)).headers["location"] == "/start/1"


@pytest.mark.thorough
def test_what_is_as_it_was_checked_is_started(desk: Desk) -> None:
    digest = checked(desk.post("check", speed="25%").text)
    desk.spec.write_text("# a comment more\n" + desk.spec.read_text())
    assert desk.post("start", checked=digest, speed="25%").status_code == 303
    assert desk.post("start").status_code == 303  # checking is offered, not demanded


@pytest.mark.thorough
@pytest.mark.parametrize(
    "fields",
    [{"overrides": "excitation.waypoints=8"}, {"station": ""}, {"speed": "10%"}, {"first": "4"}],
)
def test_a_form_that_was_changed_since_is_checked_anew(
    desk: Desk, fields: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def planned(asked: Any, gone: Any) -> Any:
        return {"plans": [], "digest": "0" * 64}

    digest = experiments_digest([load_experiment(desk.spec, desk.station)])
    monkeypatch.setattr(plan_preview, "plan_in_process", planned)
    answer = desk.post("start", checked=digest, **fields)
    assert answer.status_code == 409
    assert desk.started == []
    assert checked(answer.text) == "0" * 64
    assert desk.post("start", checked=digest).status_code == 303


def test_an_empty_form_carries_no_digest(desk: Desk) -> None:
    assert 'name="checked"' not in desk.browser.get("/start").text


def changed(experiment: Experiment, file: Path, text: str) -> tuple[str, str]:
    before = experiments_digest([experiment])
    file.write_text(text)
    return before, experiments_digest([experiment])


def test_files_that_are_named_count_by_their_content(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    (tmp_path / "poses.csv").write_text(POSES)
    experiment = load_experiment(spec, station, overrides={"excitation.file": "poses.csv"})
    before, after = changed(experiment, tmp_path / "poses.csv", POSES.replace("10", "11"))
    assert before != after
    (tmp_path / "own.yaml").write_text("a: 1\n")
    robot = experiment.robot.model_copy(update={"model": str(tmp_path / "own.yaml")})
    before, after = changed(replace(experiment, robot=robot), tmp_path / "own.yaml", "a: 2\n")
    assert before != after
