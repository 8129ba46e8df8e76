"""Going on with a run from its page, and the confirmation that a real robot needs for it."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

import hil
from hil.core.errors import DataError, RobotConnectionError
from hil.core.lock_file import hold_run
from hil.dashboard import plan_preview, run_page
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from hil.workflow.background_runs import Started, go_on_with, started_runs
from hil.workflow.live_state import read_live
from hil.workflow.motion_confirmation import Granted
from hil.workflow.remote_control import answer_run
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.confirming import (
    AT,
    ELSEWHERE,
    REAL_ARM,
    SPEC,
    cut_off_at,
    document,
    jogged,
    stand_at,
    stopped,
)
from tests.support.started_parts import PROMPT, WALL, begun
from tests.support.started_parts import SPEC as ASKING
from tests.support.waiting import until
from tests.support.web_parts import address_of_run, dashboard, plain, require_fit_for_all, seen

# Going on with a run from its page: where it is offered, what is started, what is refused


PAGE = {"accept": "text/html"}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """One that was stopped before it measured anything, as far as documents say."""
    directory = RunDirectory.create(tmp_path / "runs", "ur5", "stopped")
    directory.write_start({"uid": "u"})
    directory.write_text("spec.yaml", ASKING)
    directory.write_text("station.yaml", WALL)
    directory.write_text("plan.json", "{}")
    directory.write_stop("stopped", "lunch")
    return directory.path.resolve()


def address(run: Path) -> str:
    return "/runs/" + "/".join(run.parts[-3:])


def asked(run: Path, **fields: str) -> Any:
    settings = Settings(run.parents[2], run.parents[2] / "registry", port=8350)
    app = create_app(settings)
    browser = TestClient(app, base_url="http://127.0.0.1:8350", follow_redirects=False)
    given = {"csrf": settings.csrf, "operator": "anna"} | fields
    return browser.post(f"{address(run)}/go-on", data=given, headers=PAGE)


class Starts:
    """In place of `go_on_with`: notes what would be started."""

    def __init__(self) -> None:
        self.what: list[tuple[Path, str]] = []

    def __call__(self, run: Path, runs: Path, *, operator: str, confirmed: object) -> Any:
        assert confirmed is None
        self.what.append((run, operator))
        return SimpleNamespace(id=str(len(self.what)))


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Starts]:
    made = Starts()
    monkeypatch.setattr("hil.dashboard.run_page.go_on_with", made)
    return made


def test_it_is_offered_where_hil_resume_would_go_on(run: Path) -> None:
    client = dashboard(run.parents[3])
    html = seen(client, address(run))
    assert f'action="{address(run)}/go-on"' in html
    assert "the arm moves" in html


@pytest.mark.parametrize("why", ["commissioning", "passive", "completed", "no plan", "read-only"])
def test_it_is_not_offered_where_it_would_be_refused(run: Path, why: str) -> None:
    if why in ("commissioning", "passive"):
        (run / "start.json").write_text(json.dumps({"hil_run": 1, "uid": "u", why: {"speed": 0.1}}))
    elif why == "completed":
        (run / "stop.json").write_text(json.dumps({"hil_run": 1, "outcome": "completed"}))
    elif why == "no plan":
        (run / "plan.json").unlink()
    html = seen(dashboard(run.parents[3], read_only=why == "read-only"), address(run))
    assert "/go-on" not in html
    if why != "read-only":
        with pytest.raises(DataError):
            go_on_with(run, run.parents[2])
        assert started_runs(run.parents[2]) == []


def test_a_double_click_starts_one_attempt(run: Path, starts: Starts) -> None:
    with ThreadPoolExecutor(2) as both:
        answers = list(both.map(lambda _: asked(run, once="x"), range(2)))
    assert [each.headers["location"] for each in answers] == ["/start/1"] * 2
    assert starts.what == [(run, "anna")]


def test_only_forms_of_our_own_and_names_that_are_text_start_anything(
    run: Path, starts: Starts
) -> None:
    assert asked(run, csrf="guessed").status_code == 403
    assert asked(run, operator="an\0na").status_code == 422
    settings = Settings(run.parents[2], run, port=8350, read_only=True)
    reader = TestClient(create_app(settings), base_url="http://127.0.0.1:8350")
    form = {"csrf": settings.csrf}
    assert reader.post(f"{address(run)}/go-on", data=form).status_code == 403
    assert starts.what == []


def test_a_live_run_is_not_begun_again(run: Path) -> None:
    with hold_run(run):
        answer = asked(run)
        assert answer.status_code == 404
        assert "is running already" in plain(answer.text)
    assert started_runs(run.parents[2]) == []


def test_resume_of_a_live_page_that_is_too_late_moves_no_arm(run: Path, starts: Starts) -> None:
    client = dashboard(run.parents[3])
    (form,) = re.findall(r'name="csrf" content="([^"]+)"', seen(client, "/"))
    answer = client.post(f"{address(run)}/resume", data={"csrf": form})
    assert "not active" in answer.text
    assert starts.what == []


def test_a_record_that_names_a_folder_elsewhere_goes_on_with_nothing(tmp_path: Path) -> None:
    said = Started("x", str(tmp_path / "runs"), "/etc", "", "", 1, 1, 0.0, "h")
    assert said.again is None


@pytest.mark.wire
def test_a_stopped_run_goes_on_and_asks_again(tmp_path: Path) -> None:
    with begun(tmp_path, wall=False) as (first, run):
        until(lambda: read_live(run).get("prompt") == PROMPT)
        first.cancel()
        until(lambda: not first.alive, 20)
    where = asked(run.resolve()).headers["location"]
    (again, _) = started_runs(tmp_path / "runs")
    client = dashboard(tmp_path)
    try:
        assert again.again == run.resolve()
        if not again.made:
            assert f'href="{where}"' in seen(client, address(run))
        until(lambda: again.made, 30)
        until(lambda: read_live(run).get("prompt") == PROMPT)
        assert client.get(where, follow_redirects=False).headers["location"] == address(run)
        answer_run(run, True, who="bert")
        until(lambda: not again.alive, 40)
        directory = RunDirectory.open(run)
        assert (directory.status, directory.attempts) == ("completed", 2)
        assert json.loads((run / "resume-01.json").read_text())["operator"] == "anna"
    finally:
        again.cancel()
        until(lambda: not again.alive, 20)


# Resume in the dashboard confirms a real robot again where address or payload has changed


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')


class Form:
    """The page of a run that was stopped, at a dashboard."""

    def __init__(self, run: Path, lab: Path) -> None:
        self.run = run
        self.page = address_of_run(run, lab)
        self.browser: TestClient = dashboard(lab)
        self.csrf = self.browser.app.state.settings.csrf  # type: ignore[attr-defined]

    def resume(self, **fields: str) -> Any:
        form = {"csrf": self.csrf, "operator": "bert"} | fields
        return self.browser.post(f"{self.page}/go-on", data=form, follow_redirects=False)

    def shown(self) -> dict[str, str]:
        """What the form sends back once the motion was shown."""
        return hidden(self.resume().text)


def hidden(html: str) -> dict[str, str]:
    return dict(re.findall(r'name="(checked|facts)" value="([0-9a-f]{64})"', html))


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """The embedded mock, declared to be a real arm at an address."""
    return lambda address: stand_at(address, monkeypatch)


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of an arm at AT that was confirmed there and stopped; nothing changes it."""
    return cut_off_at(tmp_path_factory.mktemp("cut-off"))


@pytest.fixture
def form(
    cut_off: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: Callable[[str], None]
) -> Form:
    """Of a copy of that run; plans are made in this process."""
    lab = cut_off.parents[3]
    shutil.copytree(lab, tmp_path, dirs_exist_ok=True)
    at(AT)

    async def planned(asked: dict[str, Any], gone: object) -> dict[str, Any]:
        return plan_preview._plan(asked)

    monkeypatch.setattr(plan_preview, "plan_in_process", planned)
    return Form(tmp_path / cut_off.relative_to(lab), tmp_path)


@pytest.fixture
def noted_starts(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What would be started, in place of `go_on_with`."""
    noted: list[dict[str, Any]] = []

    def start(run: Path, runs: Path, **more: Any) -> Any:
        noted.append(more)
        return SimpleNamespace(id=str(len(noted)))

    monkeypatch.setattr(run_page, "go_on_with", start)
    return noted


@pytest.mark.thorough
def test_a_jogged_arm_is_confirmed_again(form: Form, noted_starts: list[dict[str, Any]]) -> None:
    jogged(form.run)
    answer = form.resume()
    assert answer.status_code == 409
    require_fit_for_all(answer.text)
    assert "not as confirmed" in plain(answer.text)
    assert noted_starts == []
    assert form.resume(confirm="ur5", **hidden(answer.text)).status_code == 303
    assert noted_starts[0]["confirmed"]["swept"]["joints"][0]["min_rad"] < -2.6


@pytest.mark.thorough
def test_as_it_was_confirmed_it_goes_on_and_nothing_is_asked(
    form: Form, noted_starts: list[dict[str, Any]]
) -> None:
    assert "to move" not in seen(form.browser, form.page)
    assert form.resume().status_code == 303
    assert noted_starts == [{"operator": "bert", "confirmed": None}]


@pytest.mark.thorough
def test_a_mock_needs_no_confirmation(
    form: Form, noted_starts: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(MockRobot, "address")
    assert form.resume().status_code == 303
    assert noted_starts[0]["confirmed"] is None


@pytest.mark.thorough
@pytest.mark.parametrize("what", ["address", "payload", "no record"])
def test_what_is_not_as_confirmed_is_shown_first(
    form: Form, noted_starts: list[dict[str, Any]], at: Callable[[str], None], what: str
) -> None:
    start = json.loads((form.run / "start.json").read_text("utf-8"))
    if what == "address":
        at(ELSEWHERE)
    elif what == "payload":
        start["confirmation"]["facts"]["loads"][0]["mass_kg"] = 0.5
    else:
        del start["confirmation"]
    (form.run / "start.json").write_text(json.dumps(start))
    answer = form.resume()
    assert answer.status_code == 409
    require_fit_for_all(answer.text)
    told = plain(answer.text)
    for text in (ELSEWHERE if what == "address" else AT, "1.5 kg at (0, 0, 50) mm", "duration",
                 "the robot allows", "elbow", "flange", "Nobody is near.", "Type ur5 to move",
                 "Resume: measure what is missing"):  # fmt: skip
        assert text in told
    assert 'name="operator" value="bert"' in answer.text
    assert noted_starts == []


@pytest.mark.thorough
def test_with_the_name_the_facts_of_what_is_left_are_confirmed(
    form: Form, noted_starts: list[dict[str, Any]], at: Callable[[str], None]
) -> None:
    at(ELSEWHERE)
    assert form.resume(confirm="ur5", once="x", **form.shown()).status_code == 303
    (started,) = noted_starts
    facts = started["confirmed"]
    whole = json.loads((form.run / "start.json").read_text("utf-8"))["confirmation"]["facts"]
    assert (started["operator"], facts["address"]) == ("bert", ELSEWHERE)
    assert facts["loads"] == whole["loads"]
    assert 0 < facts["swept"]["duration_s"] < whole["swept"]["duration_s"]


@pytest.mark.thorough
@pytest.mark.parametrize("typed", ["", "UR5"])
def test_without_the_name_nothing_goes_on(
    form: Form, noted_starts: list[dict[str, Any]], at: Callable[[str], None], typed: str
) -> None:
    at(ELSEWHERE)
    answer = form.resume(confirm=typed, **form.shown())
    assert answer.status_code == 409
    assert "ur5 was not confirmed" in plain(answer.text)
    assert hidden(answer.text).keys() == {"checked", "facts"}
    assert noted_starts == []


@pytest.mark.thorough
def test_what_was_never_shown_confirms_nothing(
    form: Form, noted_starts: list[dict[str, Any]], at: Callable[[str], None]
) -> None:
    at(ELSEWHERE)
    for fields in ({"facts": "0" * 64}, form.shown() | {"facts": "0" * 64}):
        assert form.resume(confirm="ur5", **fields).status_code == 409
    assert noted_starts == []


@pytest.mark.thorough
def test_a_station_that_was_changed_since_is_shown_again(
    form: Form, noted_starts: list[dict[str, Any]], at: Callable[[str], None]
) -> None:
    at(ELSEWHERE)
    before, copy = form.shown(), form.run / "station.yaml"
    copy.write_text(copy.read_text("utf-8").replace("Nobody is near.", "The fence is closed."))
    answer = form.resume(confirm="ur5", **before)
    assert answer.status_code == 409
    assert "changed after the check" in answer.text
    assert "The fence is closed." in answer.text
    assert hidden(answer.text)["facts"] != before["facts"]
    assert noted_starts == []


@pytest.mark.thorough
def test_a_robot_that_cannot_be_asked_where_it_stands_does_not_go_on(
    form: Form,
    noted_starts: list[dict[str, Any]],
    at: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def off(robot: MockRobot) -> None:
        raise RobotConnectionError("it is switched off", hint="switch it on")

    at(ELSEWHERE)
    monkeypatch.setattr(MockRobot, "connect", off)
    answer = form.resume(confirm="ur5")
    assert answer.status_code == 422
    assert "it is switched off" in plain(answer.text)
    assert hidden(answer.text) == {}
    assert noted_starts == []


@pytest.mark.thorough
def test_a_page_that_was_refused_leads_back_to_its_run(form: Form) -> None:
    answer = form.browser.get(f"{form.page}/go-on", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, form.page)


@pytest.mark.wire
def test_a_confirmed_form_moves_a_real_arm_and_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "real_arm-1.dist-info"
    info.mkdir()
    (tmp_path / "real_arm.py").write_text(REAL_ARM)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: real-arm\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[hil.drivers]\nreal-arm = real_arm:RealArm\n")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "small.yaml").write_text(SPEC, "utf-8")
    (tmp_path / "station.yaml").write_text(
        f"hil_station: 1\nrobots:\n  ur5: {{driver: real-arm, model: ur5, options: {{at: {AT}}}}}\n"
    )
    begun = stopped(hil.load(tmp_path / "small.yaml"), monkeypatch, Granted("--yes"))
    copy = begun.run / "station.yaml"
    copy.write_text(copy.read_text("utf-8").replace(AT, ELSEWHERE))
    form = Form(begun.run, tmp_path)
    refused = form.resume()
    assert refused.status_code == 409, plain(refused.text)
    answer = form.resume(confirm="ur5", **hidden(refused.text))
    assert answer.status_code == 303, plain(answer.text)
    (again,) = started_runs(tmp_path / "runs")
    try:
        until(lambda: not again.alive, 120)
    finally:
        again.cancel()
    resumed = document(begun, "resume-01.json")["confirmation"]
    assert (resumed["how"], resumed["by"]) == ("dashboard", "bert"), again.last_words
    assert resumed["facts"]["address"] == ELSEWHERE
    assert document(begun, "stop-01.json")["outcome"] == "completed"
