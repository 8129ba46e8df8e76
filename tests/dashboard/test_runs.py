"""Runs in the dashboard: their pages and files, the catalogue, the overview, damaged and none."""

from __future__ import annotations

import html
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.lock_file import hold_run
from hil.dashboard.catalogue import PER_PAGE
from hil.dashboard.run_files import SANDBOX
from hil.recording.run_directory import RunDirectory
from hil.robot.lease import leased
from hil.runs.catalogue import find_runs
from tests.support import docs_commands
from tests.support.browser.bench import opened, serving
from tests.support.browser.looking import problems_of, tab_to, until
from tests.support.catalogue_runs import close_folders, write_run
from tests.support.paths import EXPERIMENTS
from tests.support.recorded import SLY, run_in
from tests.support.web_parts import address_of_run, dashboard, failing, plain, seen

# What the page of a run says, and its files: none of another run, none that acts as we do


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')


@pytest.fixture
def lab(dwell_lab: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dwell_lab, tmp_path / "lab"))


@pytest.mark.thorough
def test_a_page_says_what_it_was_and_what_came_of_it(dwell_lab: Path) -> None:
    run, client = run_in(dwell_lab), dashboard(dwell_lab)
    html = seen(client, address_of_run(run, dwell_lab))
    told = plain(html)
    for text in ("Twelve static poses", "ur5-full-0", "0 kg", "dwell 24 24", "RMSE raw ≤ 0.35 A",
                 "static-wls", "J6 wrist_3_joint", "00.mcap", "&lt;img"):  # fmt: skip
        assert text in told
    assert "clock virtual: simulated" in told
    assert re.search("12\u202f\\d{3} samples in 1 min", html)
    assert '<a href="/models/ur5/v1">ur5 v1</a>' in html
    assert f'href="{address_of_run(run, dwell_lab)}/report"' in html


@pytest.mark.parametrize("clock", ["virtual", "wall", 3, None])
def test_simulated_time_is_called_so_and_no_other(lab: Path, clock: object) -> None:
    run = run_in(lab)
    start = json.loads((run / "start.json").read_text())
    start["robot"]["clock"] = clock
    (run / "start.json").write_text(json.dumps(start))
    badge = '<span class="badge quiet">virtual clock</span>'
    assert (badge in seen(dashboard(lab), address_of_run(run, lab))) == (clock == "virtual")
    with hold_run(run):
        assert (badge in seen(dashboard(lab), address_of_run(run, lab))) == (clock == "virtual")
        (run / "start.json").write_text("[1")
        assert badge not in seen(dashboard(lab), address_of_run(run, lab))


def test_what_ended_early_says_why_and_how_to_go_on(lab: Path) -> None:
    run = run_in(lab)
    stop = json.loads((run / "stop.json").read_text())
    stop |= {"outcome": "tripped", "reason": f"9 A {SLY}", "hint": "look at it", "exit_code": 4}
    (run / "stop.json").write_text(json.dumps(stop))
    (run / "verdict.json").unlink()
    told = plain(seen(dashboard(lab), address_of_run(run, lab)))
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
    html = seen(dashboard(lab), address_of_run(run, lab))
    assert 'class="trouble"' in html
    assert name in plain(html.split('class="trouble"')[1].split("</div>")[0])
    needed = name in ("start.json", "plan.json", "stop.json")
    assert ('<span class="badge fail">damaged</span>' in html) == needed
    assert "00.mcap" in html


def test_a_folder_that_was_never_begun_is_no_fault(lab: Path) -> None:
    (run_in(lab).parent / "0009-empty").mkdir()
    html = seen(dashboard(lab), address_of_run(run_in(lab, "0009-empty"), lab))
    assert "neither start.json nor plan.json" in html


def test_a_report_is_shut_in(dwell_lab: Path) -> None:
    answer = dashboard(dwell_lab).get(f"{address_of_run(run_in(dwell_lab), dwell_lab)}/report")
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
    assert client.get(f"{address_of_run(run, lab)}/report.html").headers["content-security-policy"]
    fleet = run.parents[1] / "fleet" / "fleet-small"
    fleet.mkdir(parents=True)
    (fleet / "fleet.html").write_text("<p>all</p>")
    answer = client.get(f"{address_of_run(fleet, lab)}/fleet.html")
    assert answer.text == "<p>all</p>"
    assert answer.headers["content-security-policy"].startswith("sandbox")


def test_without_a_report_the_page_says_how_to_make_one(lab: Path) -> None:
    run = run_in(lab)
    (run / "report.html").unlink()
    assert "hil report" in seen(dashboard(lab), f"{address_of_run(run, lab)}/report", status=404)
    assert "/report" not in seen(dashboard(lab), address_of_run(run, lab))


@pytest.mark.parametrize("name", ["spec.yaml", "recording/00.mcap", "plan.json"])
def test_files_are_for_keeping(dwell_lab: Path, name: str) -> None:
    run = run_in(dwell_lab)
    answer = dashboard(dwell_lab).get(f"{address_of_run(run, dwell_lab)}/file?path={name}")
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
    answer = dashboard(lab).get(f"{address_of_run(run, lab)}/file?path={path}")
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
    assert dashboard(lab).get(f"{address_of_run(run, lab)}/report").status_code == 404


def test_a_day_is_no_run(dwell_lab: Path) -> None:
    day = run_in(dwell_lab).parents[1]
    assert dashboard(dwell_lab).get(address_of_run(day, dwell_lab)).status_code == 404


# Whatever the files of a run say, every page is there, and so is Stop


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')
DEEP = '{"a": ' * 900 + "1" + "}" * 900
WHOLE = ["{}", "[]", '"x"', "1e999", DEEP, ""]
VALUES = [[1e999], {"a": [1e999]}, "x", 1e999, 10**400, None, True, -1, [[]], [{}, 3, "x", None]]
DOCUMENTS = ["start.json", "stop.json", "verdict.json", "plan.json", "preflight.json",
             "spec.yaml", "station.yaml", "events.jsonl", "fit/*/*.json",
             "study/*/*.json"]  # fmt: skip


def documents(run: Path) -> Iterator[Path]:
    for pattern in DOCUMENTS:
        yield from run.glob(pattern)


def require_all_is_there(lab: Path) -> None:
    """Pages of the overview, the catalogue, the run; and `hil runs` lists it."""
    run, client = run_in(lab), dashboard(lab)
    for address in ("/", "/runs", f"/runs/{run.relative_to(lab / 'runs')}", "/start"):
        seen(client, address)
    for query in ([], ["number>0"]):
        said = CliRunner().invoke(app, ["runs", *query, "--runs", str(lab / "runs"), "--json"])
        assert said.exit_code == 0, said.output
        (entry,) = json.loads(said.output, parse_constant=lambda name: pytest.fail(name))
        assert Path(entry["run"]) == run
    assert CliRunner().invoke(app, ["runs", "--runs", str(lab / "runs")]).exit_code == 0


@pytest.mark.thorough
@pytest.mark.parametrize("content", WHOLE, ids=lambda text: text[:6] or "empty")
def test_documents_of_another_kind_break_no_page(lab: Path, content: str) -> None:
    for file in documents(run_in(lab)):
        kept = file.read_bytes()
        file.write_text(content)
        require_all_is_there(lab)
        file.write_bytes(kept)


@pytest.mark.thorough
@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:12])
def test_values_of_another_kind_break_no_page(lab: Path, value: object) -> None:
    for file in run_in(lab).rglob("*.json"):
        kept = file.read_bytes()
        told = json.loads(kept)
        odd = {key: told[key] if key[:4] == "hil_" else value for key in told}
        if file.name == "stop.json":
            odd["outcome"] = "completed"  # else nothing but that is looked at
        file.write_text(json.dumps(odd))
        require_all_is_there(lab)
        file.write_bytes(kept)


@pytest.mark.thorough
@pytest.mark.parametrize("key", ["device_s", "samples", "reason", "problems", "stopped"])
def test_a_number_that_is_none_says_nothing(lab: Path, key: str) -> None:
    stop = run_in(lab) / "stop.json"
    stop.write_text(json.dumps(json.loads(stop.read_text()) | {key: [1]}))
    require_all_is_there(lab)
    (entry,) = find_runs(runs=lab / "runs")
    assert entry["status"] == "completed"
    if key == "device_s":
        assert entry["duration_s"] is None


@pytest.mark.thorough
@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:12])
def test_a_live_run_can_be_stopped_whatever_its_view_says(tmp_path: Path, value: object) -> None:
    run = RunDirectory.create(tmp_path / "runs", "ur5", "held")
    arm = {"q_rad": value, "effort": [value], "joints": [value, value], "moving": value}
    keys = ("step", "steps", "prompt", "state", "device_s", "duration_s", "t", "reason", "stage")
    margin = {"name": value, "share": value, "value": value, "limit": value, "unit": value}
    odd = dict.fromkeys(keys, value) | {"arm": arm, "interlocks": [margin, value]}
    with hold_run(run.path):
        run.write_start({"uid": "u"})
        where = f"/runs/{run.path.relative_to(tmp_path / 'runs')}"
        for view in (odd, odd | {"arm": value, "interlocks": value}, {"prompt": value}):
            (run.path / ".live.json").write_text(json.dumps(view))
            for address in ("/", "/runs", where, "/start"):
                answer = dashboard(tmp_path).get(address)
                assert answer.status_code == 200
                assert f'action="{where}/stop"' in answer.text
        assert f'action="{where}/stop"' in seen(dashboard(tmp_path), "/no", status=404)


def test_a_header_that_fails_is_a_name_and_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(TypeError("odd"))
    monkeypatch.setattr("hil.dashboard.live_runs.header_of", broken)
    run = RunDirectory.create(tmp_path / "runs", "ur5", "held")
    with hold_run(run.path):
        html = seen(dashboard(tmp_path), "/")
    assert "cannot be read" in html
    assert html.count(f'action="/runs/{run.path.relative_to(tmp_path / "runs")}/stop"') == 1


def test_an_error_is_told_even_where_no_page_can_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(PermissionError(13, "Permission denied", "/lab/<b>runs"))
    monkeypatch.setattr("hil.dashboard.rendering.live_headers", broken)
    answer = dashboard(tmp_path).get("/")
    assert answer.status_code == 500
    assert "/lab/&lt;b&gt;runs: Permission denied" in answer.text
    assert "<h1>" in answer.text
    assert dashboard(tmp_path).get("/no").status_code == 404


def test_a_run_that_cannot_be_understood_is_damaged_with_the_reason(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(TypeError("odd <b>"))
    monkeypatch.setattr("hil.runs.listing._from_documents", broken)
    monkeypatch.setattr("hil.dashboard.run_page._facts", broken)
    require_all_is_there(lab)
    (entry,) = find_runs(runs=lab / "runs")
    assert (entry["status"], entry["samples"]) == ("damaged", None)
    assert "TypeError: odd <b>" in entry["problem"]
    html = seen(dashboard(lab), f"/runs/{run_in(lab).relative_to(lab / 'runs')}")
    assert "TypeError: odd &lt;b&gt;" in html
    assert "00.mcap" in html


def test_a_run_of_another_user_that_may_not_be_entered_keeps_no_page_from_the_others(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_in(lab)
    shutil.copytree(run, closed := run.with_name("0002-closed"))
    close_folders(monkeypatch, closed)
    for address in ("/", "/runs", f"/runs/{run.relative_to(lab / 'runs')}"):
        seen(dashboard(lab), address)


# The catalogue in the dashboard: the same answers as `hil runs`, and pages of them


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')


@pytest.fixture(scope="module")
def sixty_runs(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    """Sixty runs of two robots; one was tripped, one is damaged, one has a sly name."""
    folder = tmp_path_factory.mktemp("lab")
    root = folder / "runs"
    for number in range(1, 58):
        robot = "ur5" if number % 3 else "ur10"
        write_run(root, number, robot=robot, fits={"rigid-wls": 1.0 / number})
    write_run(root, 58, outcome="tripped", stop={"reason": "too much current"})
    damaged = write_run(root, 59)
    (damaged / "start.json").write_text("{")
    write_run(root, 60, start={"experiment": SLY, "operator": SLY}, description=SLY)
    return dashboard(folder)


def names(html: str) -> list[str]:
    """Of the runs in the table, in its order."""
    return re.findall(r'<th scope="row" class="run"><a [^>]*>([^<]*)</a>', html)


def test_the_newest_come_first_and_the_others_on_further_pages(sixty_runs: TestClient) -> None:
    first = seen(sixty_runs, "/runs")
    assert len(names(first)) == PER_PAGE
    assert names(first)[0] == "0060-fourier"
    second = seen(sixty_runs, "/runs?page=2")
    assert names(second) == [f"{n:04d}-fourier" for n in range(10, 0, -1)]
    assert "page 2 of 2" in plain(second)


def test_a_query_finds_what_hil_runs_finds(sixty_runs: TestClient) -> None:
    found = names(seen(sixty_runs, "/runs?q=robot%3Dur10+rmse%3C0.02"))
    assert found == ["0057-fourier", "0054-fourier", "0051-fourier"]


def test_a_query_that_cannot_be_understood_is_mended_beside_the_field(
    sixty_runs: TestClient,
) -> None:
    html = seen(sixty_runs, "/runs?q=rms%3C1", status=422)
    assert 'aria-invalid="true"' in html
    assert 'value="rms&lt;1"' in html
    assert "did you mean &#39;rmse&#39;?" in html
    assert names(html) == []


def test_nothing_found_says_what_to_do(sixty_runs: TestClient) -> None:
    assert "No run matches: robot=kuka" in plain(seen(sixty_runs, "/runs?q=robot%3Dkuka"))


def test_headings_sort_and_turn_round(sixty_runs: TestClient) -> None:
    best = seen(sixty_runs, "/runs?q=rmse%3C1&sort=rmse")
    assert names(best)[0] == "0057-fourier"
    assert 'aria-sort="ascending"' in best
    turned = re.search(r'href="([^"]*sort=rmse[^"]*)"', best)
    assert turned is not None
    assert names(seen(sixty_runs, turned[1].replace("&amp;", "&")))[0] == "0002-fourier"


def test_how_a_run_ended_is_said_in_words(sixty_runs: TestClient) -> None:
    html = seen(sixty_runs, "/runs?q=status%3Dtripped")
    assert '<span class="badge fail">tripped</span>' in html
    damaged = seen(sixty_runs, "/runs?q=status%3Ddamaged")
    assert "start.json" in plain(damaged)


@pytest.mark.parametrize(
    "odd", ["page=0", "page=99", "page=x", "sort=x", "order=x", "q=%00", "q='"]
)
def test_odd_addresses_are_pages_too(sixty_runs: TestClient, odd: str) -> None:
    seen(sixty_runs, f"/runs?{odd}")


def test_without_runs_it_says_how_to_make_one(tmp_path: Path) -> None:
    assert "hil run SPEC" in seen(dashboard(tmp_path), "/runs")


def test_who_may_only_look_is_not_asked_to_start_one(tmp_path: Path) -> None:
    assert "/start" not in seen(dashboard(tmp_path, read_only=True), "/runs")


@pytest.mark.parametrize(("rmse", "said"), [(4.658e-5, "0.0466 mA"), (0.115, "0.115 A")])
def test_an_error_is_said_without_exponents(tmp_path: Path, rmse: float, said: str) -> None:
    write_run(tmp_path / "runs", 1, fits={"rigid-wls": rmse})
    assert said in plain(seen(dashboard(tmp_path), "/runs"))


def test_a_folder_of_runs_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("")
    assert "a file, not a folder of runs" in plain(seen(dashboard(tmp_path), "/runs", status=422))


def test_a_run_by_a_link_is_listed_without_an_address(tmp_path: Path) -> None:
    real = write_run(tmp_path / "elsewhere", 7)
    (tmp_path / "runs/2026-11-20/ur5").mkdir(parents=True)
    (tmp_path / "runs/2026-11-20/ur5/0007-fourier").symlink_to(real)
    html = seen(dashboard(tmp_path), "/runs")
    assert "0007-fourier" in html
    assert names(html) == []
    assert "0007-fourier" in seen(dashboard(tmp_path), "/")


# The overview: short with a hundred robots, and honest about what is a run


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')
MANY = 40


@pytest.fixture
def two_stations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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


def test_of_many_robots_those_that_are_held_are_seen_and_the_rest_is_counted(
    two_stations: Path,
) -> None:
    station = str(two_stations / "specs" / "many.yaml")
    robot: Any = SimpleNamespace(resource="many-07")
    with leased(robot, name="many-07", driver="mock", station=station):
        always, rest = card(seen(dashboard(two_stations), "/"), "many")
    assert re.findall(r"<li>([\w-]+)", always) == ["many-07"]
    assert f"{MANY} robots, 1 held" in plain(always)
    assert f"{MANY - 1} free" in plain(rest).split(">")[-1]
    assert len(re.findall("<li>", rest)) == MANY - 1
    assert not re.match("[^>]* open", rest)


def test_of_few_robots_all_are_seen(two_stations: Path) -> None:
    always, rest = card(seen(dashboard(two_stations), "/"), "few")
    assert re.findall(r"<li>([\w-]+)", always) == ["few-00", "few-01", "few-02"]
    assert rest == ""


def test_stations_of_the_same_name_are_told_apart_by_their_headings(two_stations: Path) -> None:
    text = (two_stations / "specs" / "few.yaml").read_text()
    (two_stations / "specs" / "copy.yaml").write_text(text)
    headings = re.findall(
        r"<h3>few <small>\((.*?)\)</small></h3>", seen(dashboard(two_stations), "/")
    )
    assert [Path(source).name for source in headings] == ["copy.yaml", "few.yaml"]


def test_folders_of_simulations_and_fleets_are_no_runs(two_stations: Path) -> None:
    for folder in ("simulations/simulation-weekly", "fleet/fleet-small", "series/two"):
        (two_stations / "runs" / "2026-11-22" / folder).mkdir(parents=True)
    RunDirectory.create(two_stations / "runs", "ur5", "dwell")
    html = seen(dashboard(two_stations), "/")
    assert re.findall(r'scope="row"><a href="/runs/[^"]*/([\w-]+)"', html) == ["0001-dwell"]


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_what_was_opened_by_keys_stays_open_when_a_run_begins(two_stations: Path) -> None:
    with serving(two_stations, "--specs", "specs") as address, opened() as browser:
        page = browser.new_page()
        said = problems_of(page)
        page.goto(address)
        tab_to(page, "summary")
        page.keyboard.press("Enter")
        assert page.is_visible("text=many-39")
        page.evaluate("document.activeElement.blur()")
        run = RunDirectory.create(two_stations / "runs", "ur5", "dwell")
        with hold_run(run.path):
            run.write_start({"uid": "u"})
            until(page, "document.querySelector('[data-card]') !== null", 20)
            assert page.is_visible("text=many-39")
        assert said == []


# Where there is nothing to show, a page says what would fill it and the command that does


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')
WEEKLY = EXPERIMENTS / "reidentify_weekly.yaml"


def commands_in(page: str) -> list[str]:
    """What a page says to type, as it is copied."""
    told = re.findall(r'<pre tabindex="0" aria-label="Command"><code>(.*?)</code>', page, re.S)
    return [line for text in told for line in html.unescape(text).splitlines()]


@pytest.fixture
def empty_lab(tmp_path: Path) -> Path:
    """A folder with nothing in it, whose name has a blank."""
    folder = tmp_path / "my lab"
    (folder / "specs").mkdir(parents=True)
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("address", "verbs"),
    [("/", ["run", "schedule run"]), ("/runs", ["run"]), ("/models", ["models register"]),
     ("/schedules", ["new re-identify", "schedule run"]), ("/fleets", ["fleet run"])],
)  # fmt: skip
def test_an_empty_page_says_what_fills_it(empty_lab: Path, address: str, verbs: list[str]) -> None:
    told = commands_in(seen(dashboard(empty_lab), address))
    assert all(line.startswith(f"hil {verb} ") or line == f"hil {verb}"
               for line, verb in zip(told, verbs, strict=True)), told  # fmt: skip
    for line in told:
        docs_commands.parse(line)


def test_a_schedule_that_was_never_started_says_how(empty_lab: Path) -> None:
    for file in (
        WEEKLY,
        WEEKLY.with_name("ur5_probe.yaml"),
        WEEKLY.with_name("ur5_reidentify.yaml"),
    ):
        shutil.copy(file, empty_lab / "specs")
    page = seen(dashboard(empty_lab), "/schedules/ur5-weekly")
    history = page.split('id="history"')[1].split("<h2")[0]
    assert "never been started" in history
    (line,) = commands_in(history)
    assert line.startswith("hil schedule run ")
    docs_commands.parse(line)
