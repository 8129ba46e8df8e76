"""Fleets in the dashboard: every robot, and what came of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from hil.recording.run_group import FleetGroup, Member
from tests.support.catalogue_runs import close_folders, write_run
from tests.support.recorded import SLY
from tests.support.web_parts import dashboard, plain, seen


@pytest.fixture
def fleet(tmp_path: Path) -> FleetGroup:
    """Of three robots: one has measured all, one was stopped, one was not begun."""
    runs = tmp_path / "runs"
    names = ("ur5-1", "ur5-2", "ur5-3")
    made = FleetGroup.create(runs, "small", dict.fromkeys(names, "hil: 1\n"), tmp_path / "s", "")
    first = write_run(runs, 1, robot="ur5-1")
    (first / "report.html").write_text("<p>x")
    second = write_run(runs, 2, robot="ur5-2", outcome="stopped")
    entries: list[dict[str, Any]] = [
        {"robot": "ur5-1", "run": str(first), "uid": "uid-ur5-1-1", "outcome": "completed",
         "verdict": "passed", "report": str(first / "report.html")},
        {"robot": "ur5-2", "run": str(second), "uid": "uid-ur5-2-2", "outcome": "stopped",
         "error": {"kind": "Stopped", "message": f"by hand {SLY}"}},
        {"robot": "ur5-3"},
    ]  # fmt: skip
    made.write(map(Member.from_dict, entries))
    return made


def address(fleet: FleetGroup) -> str:
    return f"/fleets/{fleet.path.relative_to(fleet.runs)}"


def test_all_fleets_are_listed_with_what_came_of_them(fleet: FleetGroup, tmp_path: Path) -> None:
    html = seen(dashboard(tmp_path), "/fleets")
    assert f'<a href="{address(fleet)}">small</a>' in html
    assert "1 completed, 1 stopped, 1 not begun; 1 passed" in plain(html)


def test_every_robot_leads_to_its_run_and_report(fleet: FleetGroup, tmp_path: Path) -> None:
    html = seen(dashboard(tmp_path), address(fleet))
    assert '<a href="/runs/2026-11-20/ur5-1/0001-fourier">0001-fourier</a>' in html
    assert 'href="/runs/2026-11-20/ur5-1/0001-fourier/report"' in html
    told = plain(html)
    for text in ("ur5-3 not begun", "stopped by hand", "hil fleet resume"):
        assert text in told
    assert "fleet.html" not in html


def test_folders_that_may_not_be_entered_are_named(
    fleet: FleetGroup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = fleet.runs / "2026-11-20" / "ur5-1" / "0001-fourier"
    close_folders(monkeypatch, fleet.path, first)
    assert f"{fleet.path}: Permission denied" in plain(seen(dashboard(tmp_path), "/fleets"))
    page = seen(dashboard(tmp_path), "/runs/2026-11-20/ur5-1/0001-fourier")
    assert "The folder of the run cannot be opened: Permission denied" in plain(page)


def test_its_page_is_shut_in(fleet: FleetGroup, tmp_path: Path) -> None:
    (fleet.path / "fleet.html").write_text("<p>all")
    client = dashboard(tmp_path)
    where = f"/runs/{fleet.path.relative_to(fleet.runs)}/fleet.html"
    assert f'href="{where}"' in seen(client, address(fleet))
    assert f'href="{where}"' in seen(client, "/fleets")
    assert client.get(where).headers["content-security-policy"].startswith("sandbox ")


def test_a_run_of_another_place_gets_no_link(fleet: FleetGroup, tmp_path: Path) -> None:
    other = write_run(tmp_path / "other", 1, robot="ur5-1")
    report = {"run": str(other), "uid": "another", "outcome": "completed"}
    fleet.write([Member("small", "ur5-1", report)])
    html = seen(dashboard(tmp_path), address(fleet))
    assert "0001-fourier" in html
    assert 'href="/runs/' not in html


def test_a_damaged_fleet_is_named_among_the_others(fleet: FleetGroup, tmp_path: Path) -> None:
    bad = fleet.path.parent / "fleet-bad"
    bad.mkdir()
    (bad / "fleet.json").write_text("{")
    html = seen(dashboard(tmp_path), "/fleets")
    assert "fleet-bad/fleet.json" in html
    assert ">small</a>" in html
    assert "fleet.json" in seen(dashboard(tmp_path), f"/fleets/{bad.relative_to(fleet.runs)}", 404)


@pytest.mark.parametrize("name", ["no", "2026-01-01/fleet/x", "%2e%2e", "..%2fx", "%00", "/etc"])
def test_what_is_not_there_is_not_found(tmp_path: Path, name: str) -> None:
    (tmp_path / "runs").mkdir()
    answer = dashboard(tmp_path).get(f"/fleets/{name}")
    assert answer.status_code == 404
    assert "<h1>" in answer.text


def test_without_fleets_it_says_how_to_run_one(tmp_path: Path) -> None:
    assert "hil fleet run SPEC" in seen(dashboard(tmp_path), "/fleets")
