"""Models in the dashboard: champions over time, drift, versions; damage is named, not suffered."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

import hil
from hil.dashboard.models import LEFT, RIGHT, WIDTH, timeline
from hil.models.drift import PROBES_FILE, assess
from hil.models.log import Entry
from hil.models.model_registry import Registry
from tests.support.drift_parts import probe
from tests.support.recorded import SLY
from tests.support.web_parts import dashboard, plain, seen

MOTION = 30


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two versions, there and back again; three quiet probes, and one with more friction."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "runs").mkdir()
    registry = Registry(folder / "registry")
    for seed in (1, 2):
        fitted = hil.fit([probe(folder, seed, noise=1)], estimator="rigid-wls", out=folder)
        total = {"mean_raw": 0.1 * seed, "rmse_raw": [0.25 * seed] * 6}
        evaluation = [{"source": SLY, "unit": "A", "total": total}]
        facts = {"estimator": "rigid-wls", "effort_kind": "current", "serial": SLY,
                 "joint_names": [f"j{k}" for k in range(6)], "evaluation": evaluation}  # fmt: skip
        registry.register("ur5", fitted.fitted.folder, facts)
    registry.promote("ur5", 1, reason="the first", evidence={}, instead_of=0)
    comparison = {"unit": "A", "joint_names": ["j1", "j2"], "champion_rmse": [0.2, 0.1],
                  "challenger_rmse": [0.1, 0.1], "words": "errs less", "samples": 17532,
                  "blocks": 3}  # fmt: skip
    evidence = {"comparison": comparison}
    registry.promote("ur5", 2, reason=f"errs less {SLY}", evidence=evidence, instead_of=1)
    registry.roll_back("ur5", reason="it shook")
    for noise in range(3):
        assess(registry, "ur5", probe(folder, MOTION, noise=noise))
    assess(registry, "ur5", probe(folder, MOTION, noise=9, more_friction=0.15))
    return folder


@pytest.fixture
def lab(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made / "registry", tmp_path / "registry")
    return tmp_path


def spoil(file: Path, text: str) -> None:
    """What is registered is read-only, which stops nobody."""
    file.chmod(0o644)
    file.write_text(text)


@pytest.mark.thorough
def test_all_names_say_who_is_in_use(made: Path) -> None:
    html = seen(dashboard(made), "/models")
    assert '<a href="/models/ur5/v1">v1</a> rigid-wls' in html
    assert "0.100 A" in plain(html)


def test_a_page_tells_champions_the_reason_of_the_way_back_and_the_comparison(made: Path) -> None:
    html = seen(dashboard(made), "/models/ur5")
    told = plain(html)
    assert "Champion is v1" in told
    for text in ("it shook", "champion again", "chain intact", "errs less", "j1 0.200 0.100 0.500"):
        assert text in told
    assert "17\u202f532 samples, 3 blocks of time" in html
    assert html.count('role="img"') == 2
    assert '<title id="timeline-title">Champions of ur5</title>' in html


def test_without_probes_and_judgement_it_is_said_how_to_get_them(lab: Path) -> None:
    Registry(lab / "registry").register("bare", lab / "registry" / "ur5" / "v0001", {})
    assert "hil drift bare RUN" in seen(dashboard(lab), "/models/bare")
    told = seen(dashboard(lab), "/models/bare/v1")
    assert "This version was not evaluated" in told
    assert "hil evaluate" in told
    assert "This version was not evaluated" not in seen(dashboard(lab), "/models/ur5/v1")


def test_the_chart_is_of_what_has_changed_until_another_is_asked_for(made: Path) -> None:
    client = dashboard(made)
    html = seen(client, "/models/ur5")
    assert "<option selected>shoulder_lift_joint friction</option>" in html
    assert "1 of 4 probes show a change" in html
    assert html.count('class="changed"') == 1
    other = seen(client, "/models/ur5?feature=load+mass")
    assert "load mass [kg]" in other
    assert 'class="changed"' not in other
    assert "shoulder_lift_joint friction [%]" in seen(client, "/models/ur5?feature=none")


def test_nothing_is_promoted_by_a_browser(made: Path) -> None:
    client = dashboard(made)
    html = seen(client, "/models/ur5")
    assert "hil models promote" not in html  # there is no challenger
    assert 'action="/models' not in html.replace('method="get" action', "")
    assert client.post("/models/ur5", data={}).status_code == 405


def test_a_first_champion_is_asked_for_no_recording(lab: Path) -> None:
    registry = Registry(lab / "registry")
    registry.register("new", registry.version("ur5", "v1").folder, {})
    text = plain(seen(dashboard(lab), "/models/new"))
    assert "There is no champion yet" in text
    assert "hil models promote new v1 --reason TEXT" in text
    assert "--on RUN" not in text


def test_a_version_says_what_it_is_and_how_others_use_it(made: Path) -> None:
    told = plain(seen(dashboard(made), "/models/ur5/v2"))
    for text in (
        "files as registered",
        "mean 0.200",
        "j5",
        "hil export",
        "--to onnx",
        "model.json",
    ):
        assert text in told


@pytest.mark.parametrize(
    "address",
    ["/models/ur6", "/models/ur5/v3", "/models/%2e%2e", "/models/%2e%2e%2fruns", "/models/%00"],
)
def test_what_is_not_there_is_not_found(made: Path, address: str) -> None:
    answer = dashboard(made).get(address)
    assert answer.status_code == 404
    assert "<h1>" in answer.text


def test_a_changed_log_is_broken_and_nobody_is_champion(lab: Path) -> None:
    log = lab / "registry" / "ur5" / "log.jsonl"
    log.write_text(log.read_text().replace("the first", "another"))
    for address in ("/models", "/models/ur5", "/models/ur5/v1"):
        html = seen(dashboard(lab), address)
        assert "the log was changed" in html
    page = plain(seen(dashboard(lab), "/models/ur5"))
    assert "log damaged" in page
    assert "Champion is" not in page
    assert "chain intact" not in page


def test_a_version_whose_files_were_changed_says_so(lab: Path) -> None:
    spoil(lab / "registry" / "ur5" / "v0002" / "model.json", "{}")
    html = seen(dashboard(lab), "/models/ur5/v2")
    assert "model.json was changed after its registration" in html
    assert "files as registered" not in html


def test_a_damaged_version_is_named_and_the_others_are_listed(lab: Path) -> None:
    spoil(lab / "registry" / "ur5" / "v0002" / "version.json", "{")
    for address in ("/models", "/models/ur5"):
        assert "v0002/version.json cannot be read" in seen(dashboard(lab), address)
    assert "/models/ur5/v1" in seen(dashboard(lab), "/models/ur5")


@pytest.mark.parametrize("content", ["{\n", "[]\n", '{"uid": 1}\n'])
def test_damaged_probes_are_named(lab: Path, content: str) -> None:
    with (lab / "registry" / "ur5" / PROBES_FILE).open("a") as file:
        file.write(content)
    html = seen(dashboard(lab), "/models/ur5")
    assert f"{PROBES_FILE}:5: damaged" in html


def test_probes_are_told_where_the_champion_of_then_is_damaged(lab: Path) -> None:
    spoil(lab / "registry" / "ur5" / "v0001" / "model.json", "{}")
    html = seen(dashboard(lab), "/models/ur5")
    assert "friction up on shoulder_lift_joint" in html
    assert 'id="control-title"' not in html


def test_without_models_it_says_how_to_register_one(tmp_path: Path) -> None:
    assert "hil models register" in seen(dashboard(tmp_path), "/models")


def test_a_timeline_keeps_within_its_picture_however_long() -> None:
    events = ("registered", "promoted", "kept", "rolled-back")
    log = [Entry(events[k % 4], 1 + k % 3, f"2026-11-{1 + k % 28:02d}", "ada") for k in range(90)]  # type: ignore[arg-type]
    told = timeline(log)
    assert told["left_out"] == 50
    assert all(LEFT <= mark["x"] <= WIDTH - RIGHT for mark in told["marks"])
    assert all(one["x"] + one["width"] <= WIDTH - RIGHT + 0.1 for one in told["spans"])
    assert [one["width"] > 0 for one in told["spans"]] == [True] * len(told["spans"])
