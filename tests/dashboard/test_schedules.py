"""Schedules in the dashboard: what is due, what became of it, and holding them by whom."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from starlette.testclient import TestClient

from hil.core.errors import FitError
from hil.dashboard.schedules import due_next
from hil.dashboard.settings import Settings
from hil.maintenance.ledger import LEDGER_FILE, Ledger, open_ledger
from hil.spec.schedule import load_schedule_spec
from tests.support.catalogue_runs import write_run
from tests.support.pipeline_parts import CAMPAIGN, PROBE
from tests.support.recorded import SLY
from tests.support.schedule_parts import raising, scheduler
from tests.support.web_parts import dashboard, plain, seen

# Nights to come, whatever day it is: none of the three that are over was kept from its probe.
DAYS = [f"{datetime.now(UTC) + timedelta(days=ahead):%a}".lower() for ahead in (2, 3)]
NIGHTLY = {
    "hil_schedule": 1, "name": "nightly", "description": f"by night {SLY}",
    "timezone": "Europe/Berlin",
    "probe": {"spec": "probe.yaml", "cron": "0 3 * * *"},
    "campaign": {"spec": "campaign.yaml"},
    "blackout": [{"days": DAYS, "begin": "02:00", "end": "05:00", "why": "backups"}],
}  # fmt: skip


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Three nights of a schedule until now, the second of which failed."""
    specs = tmp_path / "specs"
    (specs / "deeper").mkdir(parents=True)
    for name, spec in (("probe", PROBE), ("campaign", CAMPAIGN), ("nightly", NIGHTLY)):
        (specs / "deeper" / f"{name}.yaml").write_text(json.dumps(spec, indent=1))
    write_run(tmp_path / "runs", 7)
    spec = load_schedule_spec(specs / "deeper" / "nightly.yaml")
    now = datetime.now(UTC)
    with open_ledger(tmp_path / "schedules" / "nightly", "nightly") as ledger:
        loop, worker, _ = scheduler(spec, now - timedelta(days=3), ledger)
        worker.then = [lambda: None, raising(FitError(f"no motion {SLY}")), lambda: None]
        loop.run(now)
    return tmp_path


def ledger_of(lab: Path) -> Ledger:
    return Ledger.read(lab / "schedules" / "nightly")


def settings(lab: Path) -> Settings:
    return Settings(lab / "runs", lab / "registry", lab / "specs", lab / "schedules")


def say(client: TestClient, what: str, reason: str) -> int:
    """Hold or release, as the form of the page does."""
    csrf = client.app.state.settings.csrf  # type: ignore[attr-defined]
    fields = {"csrf": csrf, "reason": reason}
    answer = client.post(f"/schedules/nightly/{what}", data=fields, follow_redirects=False)
    return answer.status_code


def test_all_schedules_say_what_is_next_and_what_was_last(lab: Path) -> None:
    told = plain(seen(dashboard(lab), "/schedules"))
    for text in ("nightly", "not running", "probe, ", "03:00 (Europe/Berlin)", "done quiet"):
        assert text in told


def test_a_page_says_what_is_due_and_what_became_of_it(lab: Path) -> None:
    html = seen(dashboard(lab), "/schedules/nightly")
    told = plain(html)
    assert html.count('<span class="badge fail">failed</span>') == 1
    for text in ("backups", "no motion", "02:00 to 05:00", "started", "probe.yaml: 0 3 * * *"):
        assert text in told
    due = html.split('id="due"')[1].split("</table>")[0]
    assert due.count('scope="row"') == 12
    assert "blackout 02:00 to 05:00 (backups)" in due


def test_what_was_done_leads_to_its_runs(lab: Path) -> None:
    ledger, run = ledger_of(lab), next((lab / "runs").glob("*/*/*"))
    result = {"outcome": "quiet", "text": "x", "runs": {"probe": str(run), "check": "/gone/0009-x"}}
    ledger.add("done", datetime.now(UTC), occasion="20261123T030000Z-probe", result=result)
    html = seen(dashboard(lab), "/schedules/nightly")
    assert f'<a href="/runs/{run.relative_to(lab / "runs")}">0007-fourier</a>' in html
    assert "check 0009-x" in plain(html)


def test_it_is_held_with_a_reason_and_a_name_and_released(lab: Path) -> None:
    client = dashboard(lab)
    client.cookies.set("hil_who", "Ada%20L.")
    assert say(client, "hold", f"oil  {SLY}") == 303
    held = ledger_of(lab).standing.held
    assert held is not None
    assert (held["why"], held["by"]) == (f"oil {SLY}", "Ada L.")
    html = seen(client, "/schedules/nightly")
    assert 'action="/schedules/nightly/release"' in html
    assert "Ada L.: oil" in plain(html)
    assert say(client, "hold", "again") == 404
    assert say(client, "release", "wiped") == 303
    assert ledger_of(lab).standing.held is None
    assert ledger_of(lab).lines[-1]["by"] == "Ada L."


def test_without_a_reason_nothing_is_held(lab: Path) -> None:
    assert say(dashboard(lab), "hold", "  ") == 422
    assert ledger_of(lab).standing.held is None


def test_another_site_holds_nothing(lab: Path) -> None:
    answer = dashboard(lab).post("/schedules/nightly/hold", data={"reason": "x"})
    assert answer.status_code == 403
    assert ledger_of(lab).standing.held is None


def test_who_may_only_look_is_not_asked(lab: Path) -> None:
    client = dashboard(lab, read_only=True)
    assert "/hold" not in seen(client, "/schedules/nightly")
    assert say(client, "hold", "x") == 403
    assert ledger_of(lab).standing.held is None


def test_one_that_was_never_started_can_be_looked_at(lab: Path) -> None:
    (lab / "specs" / "other.yaml").write_text(
        json.dumps({**NIGHTLY, "name": "other"}).replace('"probe.', '"deeper/probe.')
        .replace('"campaign.', '"deeper/campaign.')
    )  # fmt: skip
    client = dashboard(lab)
    assert "never started" in plain(seen(client, "/schedules"))
    html = seen(client, "/schedules/other")
    assert "It has never been started" in plain(html)
    assert "/hold" not in html


def test_a_damaged_ledger_is_named_and_cannot_be_held(lab: Path) -> None:
    path = lab / "schedules" / "nightly" / LEDGER_FILE
    path.write_text(path.read_text().replace("quiet", "loud"))
    client = dashboard(lab)
    assert "damaged" in plain(seen(client, "/schedules"))
    html = seen(client, "/schedules/nightly")
    assert "the ledger was changed" in html
    assert "/hold" not in html
    assert say(client, "hold", "x") == 404
    assert due_next(settings(lab)) == []


@pytest.mark.parametrize("content", ["hil_schedule: [", "hil_schedule: 1\nname: nightly\n"])
def test_a_damaged_file_is_named_and_the_history_is_shown(lab: Path, content: str) -> None:
    (lab / "specs" / "deeper" / "nightly.yaml").write_text(content)
    html = seen(dashboard(lab), "/schedules/nightly")
    assert "nightly.yaml:" in html
    assert '<span class="badge fail">failed</span>' in html


@pytest.mark.parametrize("name", ["../../etc", "/etc", ".", SLY, 7])
def test_a_name_that_leads_elsewhere_is_none(lab: Path, name: object) -> None:
    (lab / "specs" / "odd.yaml").write_text(json.dumps({**NIGHTLY, "name": name}))
    html = seen(dashboard(lab), "/schedules")
    assert 'href="/schedules/odd"' in html or 'href="/schedules/7"' in html


@pytest.mark.parametrize("name", ["nightl", "%2e%2e", "%00", "nightly%2f.."])
def test_what_is_not_there_is_not_found(lab: Path, name: str) -> None:
    answer = dashboard(lab).get(f"/schedules/{name}")
    assert answer.status_code == 404
    assert "<h1>" in answer.text


def test_a_schedule_of_every_minute_that_slept_a_year_is_answered_at_once(lab: Path) -> None:
    spec = {**NIGHTLY, "probe": {"spec": "probe.yaml", "every": "1min"}}
    (lab / "specs" / "deeper" / "nightly.yaml").write_text(json.dumps(spec))
    (lab / "schedules" / "nightly" / LEDGER_FILE).unlink()
    ledger_of(lab).start("nightly", datetime.now(UTC) - timedelta(days=365))
    assert "Too many occasions were missed" in seen(dashboard(lab), "/schedules/nightly")


def test_what_is_coming_is_told_soonest_first(lab: Path) -> None:
    found = due_next(settings(lab))
    assert [one["due"] for one in found] == sorted(one["due"] for one in found)
    assert {one["job"] for one in found} == {"probe"}
    assert found[0]["due"] > datetime.now(UTC)
    assert (found[0]["held"], found[0]["run_by"]) == ("", "")
    assert found[0]["when"].endswith("03:00 (Europe/Berlin)")
    with open_ledger(lab / "schedules" / "nightly", "nightly") as ledger:
        ledger.add("held", datetime.now(UTC), why="oil", by="ada")
        held = due_next(settings(lab))[0]
    assert held["held"] == "oil"
    assert held["run_by"].startswith("pid ")


def test_without_schedules_it_says_how_to_begin(tmp_path: Path) -> None:
    assert "hil schedule run FILE" in seen(dashboard(tmp_path, specs=None), "/schedules")
