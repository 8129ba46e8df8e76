"""A start that found its robot held leads to the run that holds it."""

from __future__ import annotations

import json
import platform
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.core.errors import RobotConnectionError
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.dashboard.start_page import lock_owner
from hil.robot.lease import leased
from hil.workflow.background_runs import FOLDER, Started


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(tmp_path / "runs", tmp_path / "registry", port=8350)


def words(run: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """What `hil run` says of a robot that a run has."""
    monkeypatch.setenv("HIL_LEASES", str(run.parent / "leases"))
    robot: Any = SimpleNamespace(resource="arm-17")
    about = {"name": "ur5", "driver": "mock", "station": "bench"}
    with leased(robot, **about) as lease:
        lease.note_run(run)
        with pytest.raises(RobotConnectionError) as refused:
            leased(robot, **about)
    return f"RobotConnectionError: {refused.value.message}"


def test_the_page_of_the_start_leads_to_the_run(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = settings.runs / "2026-11-23" / "ur5" / "0006-ci-dwell-12"
    run.mkdir(parents=True)
    (settings.runs / FOLDER).mkdir()
    said = Started(
        id="17", runs=str(settings.runs), spec="a.yaml", station="", operator="anna", pid=1,
        ticks=1, time=0.0, host=platform.node(),
    )  # fmt: skip
    (settings.runs / FOLDER / "17.json").write_text(json.dumps(asdict(said)))
    said.log.write_text(f"{words(run, monkeypatch)}\n  next: wait\n")
    text = TestClient(create_app(settings), base_url="http://127.0.0.1:8350").get("/start/17").text
    link = '<a href="/runs/2026-11-23/ur5/0006-ci-dwell-12">2026-11-23/ur5/0006-ci-dwell-12</a>'
    assert f"a.yaml did not begin: robot ur5 is held by run {link}." in text


def test_a_run_kept_elsewhere_and_other_words_lead_nowhere(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.runs.mkdir()
    elsewhere = tmp_path / "others" / "0001-a"
    elsewhere.mkdir(parents=True)
    assert lock_owner([words(elsewhere, monkeypatch), "SpecError: a", ""], settings) is None
