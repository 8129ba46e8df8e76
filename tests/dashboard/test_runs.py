"""What the page of a run says, and its files: none of another run, none that acts as we do."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from hil.core.lock_file import hold_run
from hil.dashboard.run_files import SANDBOX
from tests.support.recorded import SLY, run_in
from tests.support.web_parts import address_of_run as address
from tests.support.web_parts import dashboard, plain, seen


@pytest.fixture
def lab(dwell_lab: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dwell_lab, tmp_path / "lab"))


@pytest.mark.thorough
def test_a_page_says_what_it_was_and_what_came_of_it(dwell_lab: Path) -> None:
    run, client = run_in(dwell_lab), dashboard(dwell_lab)
    html = seen(client, address(run, dwell_lab))
    told = plain(html)
    for text in ("Twelve static poses", "ur5-full-0", "0 kg", "dwell 24 24", "RMSE raw ≤ 0.35 A",
                 "static-wls", "J6 wrist_3_joint", "00.mcap", "&lt;img"):  # fmt: skip
        assert text in told
    assert "clock virtual: simulated" in told
    assert re.search("12\u202f\\d{3} samples in 1 min", html)
    assert '<a href="/models/ur5/v1">ur5 v1</a>' in html
    assert f'href="{address(run, dwell_lab)}/report"' in html


@pytest.mark.parametrize("clock", ["virtual", "wall", 3, None])
def test_simulated_time_is_called_so_and_no_other(lab: Path, clock: object) -> None:
    run = run_in(lab)
    start = json.loads((run / "start.json").read_text())
    start["robot"]["clock"] = clock
    (run / "start.json").write_text(json.dumps(start))
    badge = '<span class="badge quiet">virtual clock</span>'
    assert (badge in seen(dashboard(lab), address(run, lab))) == (clock == "virtual")
    with hold_run(run):
        assert (badge in seen(dashboard(lab), address(run, lab))) == (clock == "virtual")
        (run / "start.json").write_text("[1")
        assert badge not in seen(dashboard(lab), address(run, lab))


def test_what_ended_early_says_why_and_how_to_go_on(lab: Path) -> None:
    run = run_in(lab)
    stop = json.loads((run / "stop.json").read_text())
    stop |= {"outcome": "tripped", "reason": f"9 A {SLY}", "hint": "look at it", "exit_code": 4}
    (run / "stop.json").write_text(json.dumps(stop))
    (run / "verdict.json").unlink()
    told = plain(seen(dashboard(lab), address(run, lab)))
    for text in ("An interlock stopped the robot", "→ look at it", "hil resume", "exit code 4"):
        assert text in told


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name", ["start.json", "stop.json", "plan.json", "verdict.json", "spec.yaml", "preflight.json"]
)
@pytest.mark.parametrize("content", [b"{", b"\xff\xfe"])
def test_a_damaged_file_is_named_and_the_rest_is_shown(
    lab: Path, name: str, content: bytes
) -> None:
    run = run_in(lab)
    (run / name).write_bytes(content)
    html = seen(dashboard(lab), address(run, lab))
    assert 'class="trouble"' in html
    assert name in plain(html.split('class="trouble"')[1].split("</div>")[0])
    needed = name in ("start.json", "plan.json", "stop.json")
    assert ('<span class="badge fail">damaged</span>' in html) == needed
    assert "00.mcap" in html


def test_a_folder_that_was_never_begun_is_no_fault(lab: Path) -> None:
    (run_in(lab).parent / "0009-empty").mkdir()
    html = seen(dashboard(lab), address(run_in(lab, "0009-empty"), lab))
    assert "neither start.json nor plan.json" in html


def test_a_report_is_shut_in(dwell_lab: Path) -> None:
    answer = dashboard(dwell_lab).get(f"{address(run_in(dwell_lab), dwell_lab)}/report")
    assert answer.status_code == 200
    assert "<title>" in answer.text
    for name, value in SANDBOX.items():
        assert answer.headers[name] == value
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts allow-popups; default-src 'none'")
    assert "allow-same-origin" not in policy
    assert "allow-top-navigation" not in policy


def test_pages_are_where_links_between_them_look(lab: Path) -> None:
    run = run_in(lab)
    client = dashboard(lab)
    assert client.get(f"{address(run, lab)}/report.html").headers["content-security-policy"]
    fleet = run.parents[1] / "fleet" / "fleet-small"
    fleet.mkdir(parents=True)
    (fleet / "fleet.html").write_text("<p>all</p>")
    answer = client.get(f"{address(fleet, lab)}/fleet.html")
    assert answer.text == "<p>all</p>"
    assert answer.headers["content-security-policy"].startswith("sandbox")


def test_without_a_report_the_page_says_how_to_make_one(lab: Path) -> None:
    run = run_in(lab)
    (run / "report.html").unlink()
    assert "hil report" in seen(dashboard(lab), f"{address(run, lab)}/report", status=404)
    assert "/report" not in seen(dashboard(lab), address(run, lab))


@pytest.mark.parametrize("name", ["spec.yaml", "recording/00.mcap", "plan.json"])
def test_files_are_for_keeping(dwell_lab: Path, name: str) -> None:
    run = run_in(dwell_lab)
    answer = dashboard(dwell_lab).get(f"{address(run, dwell_lab)}/file?path={name}")
    assert answer.content == (run / name).read_bytes()
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"].startswith("attachment; filename=")


@pytest.mark.parametrize(
    "path",
    ["", ".", "..", "../../../../registry/ur5/log.jsonl", "/etc/passwd", ".lock", "recording",
     "recording/../spec.yaml", "recording/../../../../../registry/ur5/log.jsonl", "%00",
     "secret.txt", "linked/secret.txt", "fit/secret.txt", "study/m/secret.txt", "study/own.txt"],
)  # fmt: skip
def test_nothing_but_a_run_s_own_files_is_given(lab: Path, path: str) -> None:
    run = run_in(lab)
    secret = lab / "secret.txt"
    secret.write_text("secret")
    (run / "secret.txt").symlink_to(secret)
    (run / "linked").symlink_to(lab, target_is_directory=True)
    shutil.rmtree(run / "fit")
    (run / "fit").symlink_to(lab, target_is_directory=True)
    (run / "study" / "m").mkdir(parents=True)
    (run / "study" / "m" / "secret.txt").symlink_to(secret)
    (run / "study" / "own.txt").symlink_to(secret)
    (run / ".lock").write_text("{}")
    answer = dashboard(lab).get(f"{address(run, lab)}/file?path={path}")
    assert answer.status_code == 404
    assert "secret" not in answer.text.replace("secret.txt", "")


@pytest.mark.parametrize(
    "where",
    ["/runs/../registry/ur5", "/runs/%2e%2e/registry/ur5", "/runs/..%2f..%2fetc", "/runs//etc",
     "/runs/2026-01-01/ur5/0001-no", "/runs/%2e%2e/secret.html", "/runs/..%2fsecret.html",
     "/runs/2026-01-01/report", "/runs/%00", "/runs/" + 300 * "x", "/runs/%00/report",
     "/runs/%00.html"],
)  # fmt: skip
def test_there_are_no_runs_elsewhere(lab: Path, where: str) -> None:
    (lab / "secret.html").write_text("secret")
    answer = dashboard(lab).get(where)
    assert answer.status_code == 404
    assert "<h1>" in answer.text
    assert ">secret" not in answer.text


def test_a_report_that_is_a_link_is_none(lab: Path) -> None:
    run, secret = run_in(lab), lab / "secret.html"
    secret.write_text("secret")
    (run / "report.html").unlink()
    (run / "report.html").symlink_to(secret)
    assert dashboard(lab).get(f"{address(run, lab)}/report").status_code == 404


def test_a_day_is_no_run(dwell_lab: Path) -> None:
    day = run_in(dwell_lab).parents[1]
    assert dashboard(dwell_lab).get(address(day, dwell_lab)).status_code == 404
