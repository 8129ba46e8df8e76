"""Names of files are bytes of any kind: every verb, page and document survives them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable
from contextlib import ExitStack
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markupsafe import escape

from hil.core.files import json_document, json_line, read_json
from hil.core.lock_file import hold_run
from hil.core.text import json_text, name_read, name_text, quoted, shell_word, utf8_text
from hil.dashboard import run_page
from hil.models.log import damaged
from hil.recording.run_directory import RunDirectory
from hil.recording.run_group import FleetGroup, Member
from tests.support.catalogue_runs import write_run
from tests.support.command import hil
from tests.support.paths import FILES
from tests.support.pipeline_parts import CAMPAIGN, PROBE
from tests.support.recorded import DWELL
from tests.support.web_parts import dashboard, require_fit_for_all

pytestmark = pytest.mark.usefixtures("plans_once")

URDF = FILES / "own_arm.urdf"
WORST = os.fsdecode(b"d\xff \x1b[31m'\"\n\t<img src=x onerror=alert(1)>\\x41%41")
NAMES = {
    "not UTF-8": os.fsdecode(b"d\xff"),
    "half a character": os.fsdecode("Žofie".encode()[:1]),
    "line break": "a\nb\r\nc",
    "tab and quotes": "t\t'\"`$(x)",
    "control characters": "c\x01\x1b[2J\x7f\x85",
    "HTML": "<img src=x onerror=alert(1)>&amp;",
    "escapes": r"\xff \\ %ff",
    "right to left": "\u202e\ufdfa\u200b",
    "as long as can be": "n" * 240,
    "all at once": WORST,
}
"""Texts that a name may hold; a slash and a NUL are all that a file system refuses."""

name_of_a_file = st.binary(min_size=1, max_size=40).map(
    lambda raw: os.fsdecode(raw.replace(b"/", b"-").replace(b"\0", b"\xff"))
)


@given(name_of_a_file)
@example(WORST)
def test_a_name_leaves_as_text_and_comes_back_as_it_was(name: str) -> None:
    assert name_read(name_text(name)) == name
    assert name_text(name).isprintable()
    assert utf8_text(name).encode()
    assert json.loads(json_text({name: name}).encode()) == {name: name}
    assert "\n" not in json_text(name)
    assert quoted(name).isascii()


@given(st.text(st.characters(), max_size=20))
def test_every_text_can_be_a_document(text: str) -> None:
    assert json.loads(json_document([text])) == [text]
    assert json.loads(json_line(text).encode()) == text
    utf8_text(text).encode()


def test_a_set_is_written_in_one_order_whatever_the_hashes() -> None:
    names = [f"joint {i:02d}" for i in range(30)]
    assert json.loads(json_line({"columns": frozenset(names)})) == {"columns": names}


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_shell_takes_the_word_for_the_name(name: str) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    import subprocess

    said = subprocess.run([bash, "-c", f"printf %s {shell_word(name)}"], capture_output=True)
    assert said.stdout == os.fsencode(name)


@pytest.fixture(scope="module")
def lab(dwell_lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in a folder, below a folder of runs, under the worst of names; model and schedule."""
    home = tmp_path_factory.mktemp("odd") / WORST
    shutil.copytree(dwell_lab, home)
    (home / "runs").rename(home / f"runs-{WORST}")
    shutil.copy(DWELL, home / f"{WORST}.yaml")
    for name, spec in (("probe", PROBE), ("campaign", CAMPAIGN)):
        (home / f"{name}.yaml").write_text(json.dumps(spec))
    (home / f"schedule-{WORST}.yaml").write_text(
        "hil_schedule: 1\nname: nightly\nprobe: {spec: probe.yaml, cron: '0 3 * * *'}\n"
        "campaign: {spec: campaign.yaml}\n"
    )
    return home


@pytest.fixture
def places(lab: Path, tmp_path: Path) -> dict[str, Path]:
    """What the verbs are called with."""
    (run,) = lab.glob("runs*/*/*/0*")
    (model, *_) = sorted(run.glob("fit/static-wls*"))
    return {"spec": lab / f"{WORST}.yaml", "runs": run.parents[2], "run": run, "model": model,
            "registry": lab / "registry", "new": tmp_path / f"new-{WORST}",
            "schedule": lab / f"schedule-{WORST}.yaml"}  # fmt: skip


VERBS = {
    "validate": "{spec}",
    "plan": "{spec}",
    "optimise": "{spec} --out {new}.html",
    "runs": "--runs {runs}",
    "runs number>0": "--runs {runs}",
    "show": "{run}",
    "recover": "{run}",
    "resume": "{run}",
    "report": "{run}",
    "figures": "{run} --out {new} --format svg",
    "export-data": "{run} --out {new}.csv",
    "export-data --out {new}.npz": "{run}",
    "export-data --out {new}.parquet": "{run}",
    "fit -e static-wls": "{run} --out {new}",
    "evaluate": "{model} {run}",
    "payload": "{model} {run}",
    "drive-gains": "{run} --out {new}.yaml",
    "validate-loads": "{run}",
    "rest-pose": "{model}",
    "export --to c": "{model} --no-check --out {new}",
    "export --to json": "{model} --out {new}.json",
    "import": "{spec} --map {spec} --out {new}.mcap",
    "drift ur5": "{run} --registry {registry} --page {new}.html",
    "prune": "--runs {runs} --keep 1 --registry {registry}",
    "models list": "--registry {registry}",
    "models show": "ur5 --registry {registry}",
    "models log": "ur5 --registry {registry}",
    "models check": "--registry {registry}",
    "models register": "{model} --name again --registry {new}",
    "models promote": "ur5 v1 --registry {registry}",
    "schedule show": "{schedule} --state {new}",
    "schedule plan": "{schedule}",
    "schedule hold": "{schedule} --state {new} --reason x",
    "schedule systemd": "{schedule} --state {new} --out {new}",
    "fleet report": "{run}",
    "robots": "--station {run}/station.yaml",
    "watch": "{run}",
    "stop": "{run}",
}  # fmt: skip


DRAWN = "figures"
"""A verb that takes seconds: it is called once, for both, as its document names what it writes."""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("verb", "as_json"),
    [(verb, as_json) for verb in VERBS for as_json in (False, True) if as_json or verb != DRAWN],
)
def test_every_verb_ends_as_it_would_with_another_name(
    verb: str,
    as_json: bool,
    places: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # `plan` draws its picture there
    words = [word.format(**places) for word in f"{verb} {VERBS[verb]}".split(" ")]
    said = hil(*words, *(["--json"] if as_json else []))
    assert said.returncode in (0, 2, 8, 9, 11)
    if as_json and "No such option: --json" not in said.stderr:
        for line in said.stdout.splitlines() if verb == "watch" else [said.stdout]:
            json.loads(line)


@pytest.mark.thorough
def test_a_run_ends_with_its_report(places: dict[str, Path], tmp_path: Path) -> None:
    runs = tmp_path / f"runs-{WORST}"
    said = hil("run", places["spec"], "--runs", runs, "--operator", "ada", "--json")
    assert said.returncode == 0, said.stderr
    (run,) = runs.glob("*/*/0*")
    assert Path(said.document["run"]) == run
    assert Path(read_json(run / "start.json")["spec"]).samefile(places["spec"])
    assert "</html>" in (run / "report.html").read_text("utf-8")


@pytest.mark.thorough
def test_an_arm_of_ones_own_may_stand_in_a_folder_of_any_name(tmp_path: Path) -> None:
    home = tmp_path / WORST
    assert hil("new", "own-urdf", "--urdf", URDF, "--out", home).returncode == 0
    (home / "small.yaml").write_text(DWELL.read_text().replace("robot: ur5", "robot: own_arm"))
    words = ("--station", home / "own_arm-station.yaml", "--runs", home / "runs", "--json")
    said = hil("run", home / "small.yaml", *words)
    assert said.returncode == 0, said.stderr
    report = hil("report", said.document["run"], "--json")  # from the station it has copied
    assert report.returncode == 0, report.stderr


@pytest.mark.thorough
def test_the_catalogue_has_a_run_of_any_name(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    write_run(root, 7)
    for number, name in enumerate(NAMES.values(), 10):
        run = write_run(root, number, name="x")
        run.rename(run.with_name(f"{number:04d}-{name}"))
    there = {str(path) for path in root.glob("*/*/*")}
    assert len(there) == 1 + len(NAMES)
    for query in ((), ("number>0",), ("number>0", "--rebuild")):  # read, kept, and read again
        said = hil("runs", *query, "--runs", root, "--json")
        assert {one["run"] for one in said.document} == there
        assert hil("runs", *query, "--runs", root).stdout.count("completed") == len(there)


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_suggested_command_names_the_folder_whatever_its_name(name: str, tmp_path: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    import subprocess

    root = tmp_path / name / "runs"
    run = write_run(root, 7)
    table = hil("runs", "--runs", root).stdout
    entries = hil("runs", "--runs", root, "--json").document
    hint = damaged(root / "ur5", "a line is damaged").hint
    suggested = {
        table.partition("hil report 7 --runs ")[2]: root,
        entries[0]["next"].removeprefix("hil report "): run,
        hint.partition(" --registry ")[2]: root,
    }
    for words, folder in suggested.items():
        shell = subprocess.run([bash, "-c", f"printf %s {words}"], capture_output=True)
        assert shell.stdout == os.fsencode(folder)


def crawl(client: Any, first: Iterable[str]) -> dict[str, str]:
    """Every page that is linked from some, with all links of each leading somewhere."""
    pages: dict[str, str] = {}
    left = list(first)
    while left:
        address = left.pop()
        if address in pages:
            continue
        answer = client.get(address)
        assert answer.status_code == 200, (address, answer.text[-600:])
        pages[address] = ""
        if answer.headers["content-type"].startswith("text/html") and "sandbox" not in str(
            answer.headers
        ):
            pages[address] = answer.text
            require_fit_for_all(answer.text)
            links = _Links()
            links.feed(answer.text)
            left += [link.partition("#")[0] for link in links.found if link[:1] == "/"]
    return pages


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at a tag."""
        self.found += [value for name, value in attrs if tag == "a" and name == "href" and value]


NAVIGATION = ("/", "/runs", "/models", "/schedules", "/fleets", "/start")


def test_every_page_of_the_dashboard_is_there_with_all_it_links_to(
    lab: Path, places: dict[str, Path]
) -> None:
    fleet = FleetGroup.create(places["runs"], "x", {"ur5": "hil: 1\n"}, places["spec"], "")
    report = {"run": str(places["run"]), "outcome": "completed"}
    fleet.write([Member("x", "ur5", report)])
    odd = fleet.path.rename(fleet.path.with_name(f"fleet-{WORST}"))
    (odd / "fleet.html").write_text("<p>all")
    client = dashboard(lab, runs=places["runs"], specs=lab)
    pages = crawl(client, NAVIGATION)
    for wanted in ("/report", ".html", "/file?path=", "/models/ur5/v1", "/schedules/", "/fleets/"):
        assert any(wanted in address for address in pages), wanted
    shutil.rmtree(odd)


@pytest.mark.thorough
def test_stop_is_on_every_page_beside_runs_of_any_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_page, "LISTENS_WITHIN_S", 0.1)
    root = tmp_path / "runs"
    write_run(root, 7)
    with ExitStack() as held:
        stops = []
        for number, name in enumerate(NAMES.values(), 10):
            run = RunDirectory.create(root, "ur5", "x")
            run.write_start({"uid": f"u{number}"})
            odd = run.path.rename(run.path.with_name(f"{number:04d}-{name}"))
            held.enter_context(hold_run(odd))
            stops.append(f"/runs/{quoted(odd.relative_to(root))}")
        client = dashboard(tmp_path)
        for address in (*NAVIGATION, *stops, "/no"):
            answer = client.get(address)
            assert answer.status_code == (404 if address == "/no" else 200), answer.text[-600:]
            assert [one for one in stops if f'action="{one}/stop"' not in answer.text] == []
        crawl(client, NAVIGATION)
        form = {"csrf": client.app.state.settings.csrf}
        for where in stops:
            answer = client.post(f"{where}/stop", data=form, headers={"accept": "application/json"})
            assert (
                "does not accept requests" in answer.json()["error"]
            )  # found, and its process is a test


@pytest.mark.thorough
def test_a_spec_of_any_name_is_checked_and_planned_from_its_form(
    lab: Path, places: dict[str, Path]
) -> None:
    client = dashboard(lab, runs=places["runs"], specs=lab)
    name = name_text(places["spec"].name)
    assert f'<option value="{escape(name)}">' in client.get("/start").text
    form = {"csrf": client.app.state.settings.csrf, "spec": name, "do": "check"}
    answer = client.post("/start", data=form)
    assert answer.status_code == 200, answer.text[-600:]
    assert "Planned program" in answer.text
    assert f'<option value="{escape(name)}" selected>' in answer.text


@pytest.mark.parametrize("inside", ["start.json", "stop.json", "plan.json", "events.jsonl", "fit"])
def test_a_foreign_folder_costs_its_own_row_only(tmp_path: Path, inside: str) -> None:
    runs = tmp_path / "runs"
    write_run(runs, 7)
    foreign = write_run(runs, 8, name="foreign") / inside
    for make in (foreign.mkdir, lambda: foreign.symlink_to(foreign), lambda: os.mkfifo(foreign)):
        shutil.rmtree(foreign) if foreign.is_dir() else foreign.unlink(missing_ok=True)
        make()
        client = dashboard(tmp_path)
        for address in ("/", "/runs", "/runs/2026-11-20/ur5/0007-fourier"):
            answer = client.get(address)
            assert answer.status_code == 200, answer.text[-600:]
            assert "0007-fourier" in answer.text
        assert "0008-foreign" in client.get("/runs").text
