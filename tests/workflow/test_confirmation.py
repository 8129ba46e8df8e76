"""A real robot moves only when its motion was confirmed: of one run, of many, of a schedule."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import hil
import hil.arms
from hil.arms import description
from hil.cli.app import app
from hil.core.errors import DataError, NotConfirmed, RobotFault, SpecError, exit_code_of
from hil.maintenance import reidentifying
from hil.maintenance.binding import bind_file
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from hil.planning.plan import Plan
from hil.planning.robots import opened
from hil.robot import Address
from hil.workflow import arming, background_runs, motion_confirmation
from hil.workflow.arming import ARMED_FILE, Moves, Together, arm, confirm_together, require_armed
from hil.workflow.motion_confirmation import (
    Granted,
    TypedName,
    Unconfirmed,
    differences,
    digest_of,
    facts_of_all,
    granted_in,
    motion_facts,
)
from hil.workflow.preview import planned
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.confirming import (
    AT,
    ELSEWHERE,
    REAL_ARM,
    SPEC,
    STATION,
    FakeConsole,
    cut_off_at,
    desk,
    document,
    jogged,
    run,
    stand_at,
    stopped,
)
from tests.support.fleet_parts import SPEC as MEMBER
from tests.support.pipeline_parts import CAMPAIGN, PROBE, SCHEDULE, write_schedule

pytestmark = pytest.mark.usefixtures("plans_once")

# A real robot moves only when its motion was confirmed; mocks and loopback ask nothing


@pytest.fixture
def experiment(tmp_path: Path) -> hil.Experiment:
    (tmp_path / "small.yaml").write_text(SPEC, "utf-8")
    (tmp_path / "station.yaml").write_text(STATION, "utf-8")
    return hil.load(tmp_path / "small.yaml")


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """The embedded mock, declared to be a real arm at an address."""

    stand_at(AT, monkeypatch)
    return lambda address: stand_at(address, monkeypatch)


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a real robot that was stopped after its first measurements; stays as it is."""
    return cut_off_at(tmp_path_factory.mktemp("cut-off"))


@pytest.fixture
def begun(cut_off: Path, tmp_path: Path) -> Path:
    """A copy of that run, to go on with."""
    return shutil.copytree(cut_off, tmp_path / "runs" / "small" / "ur5" / cut_off.name)


def content(path: Path) -> dict[str, Any]:
    """Return the JSON document of a file."""
    out: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return out


def test_a_real_robot_is_not_even_connected_to_when_nobody_can_confirm(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MockRobot, "connect", lambda robot: pytest.fail("it was connected to"))
    with pytest.raises(NotConfirmed, match=f"ur5 at {AT} is a real robot") as refused:
        run(experiment, TypedName(FakeConsole(there=False)))
    assert "--yes" in refused.value.hint
    assert exit_code_of(refused.value) == 3
    assert not (experiment.folder / "runs").exists()


@pytest.mark.thorough
def test_what_a_driver_says_once_it_is_connected_takes_no_confirmation_back(
    real: Callable[[str], None], experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = MockRobot.connect

    def connecting(robot: MockRobot) -> None:
        monkeypatch.setattr(MockRobot, "address", Address("this process", real=False))
        connect(robot)

    monkeypatch.setattr(MockRobot, "connect", connecting)
    answer = document(run(experiment, Granted("--yes")))["confirmation"]
    assert answer["facts"]["address"] == AT


@pytest.mark.thorough
def test_its_name_moves_it_and_what_was_shown_is_recorded_and_executed(
    real: object, experiment: hil.Experiment
) -> None:
    console = FakeConsole(None, "ur5")
    report = run(experiment, TypedName(console, "anna"))
    answer = document(report)["confirmation"]
    shown, facts = "\n".join(console.shown), answer["facts"]
    assert (answer["how"], answer["by"]) == ("typed", "anna")
    assert answer["digest"] == digest_of(facts)
    assert facts["address"] == AT
    assert facts["loads"] == [{"mass_kg": 1.5, "com_m": [0.0, 0.0, 0.05]}]
    assert facts["checklist"] == ["The emergency stop is within reach.", "Nobody is near."]
    for said in (AT, "1.5 kg at (0, 0, 50) mm", "wrist_3_joint", "elbow", "Nobody is near."):
        assert said in shown
    assert console.shown[-1].startswith("type ur5 to move")
    executed = Plan.from_dict(document(report, "plan.json"))
    assert facts["swept"]["duration_s"] == executed.duration_s
    assert [j["min_rad"] for j in facts["swept"]["joints"]] == executed.extremes.q_min.tolist()
    assert facts["speed_rad_s"] == executed.extremes.qd_max.max()


@pytest.mark.thorough
@pytest.mark.parametrize("typed", ["", "UR5", "ur", "yes"])
def test_any_other_answer_leaves_it_where_it_is(
    real: object, experiment: hil.Experiment, typed: str
) -> None:
    with pytest.raises(NotConfirmed, match="nothing has moved"):
        run(experiment, TypedName(FakeConsole(typed)))
    assert not (experiment.folder / "runs").exists()


@pytest.mark.thorough
def test_a_terminal_that_goes_away_confirms_nothing(
    real: object, experiment: hil.Experiment
) -> None:
    console = FakeConsole()
    console.on_line = lambda: setattr(console, "there", False)
    with pytest.raises(NotConfirmed):
        run(experiment, TypedName(console))


@pytest.mark.thorough
def test_the_robot_is_not_held_forever_for_an_answer(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion_confirmation, "ANSWER_WITHIN_S", 0.0)
    with pytest.raises(NotConfirmed):
        run(experiment, TypedName(FakeConsole("ur5")))


@pytest.mark.thorough
def test_a_signal_at_the_question_ends_as_documented(
    real: object, experiment: hil.Experiment
) -> None:
    console = FakeConsole()
    console.on_line = lambda: signal.raise_signal(signal.SIGINT)
    with pytest.raises(hil.core.errors.Stopped) as ended:
        run(experiment, TypedName(console))
    assert exit_code_of(ended.value) == 130


@pytest.mark.thorough
def test_a_fault_at_the_question_is_an_error_of_the_robot(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = FakeConsole(None, None, "ur5")

    def faulty(robot: MockRobot, timeout_s: float = 1.0) -> None:
        raise RobotFault("protective stop")

    console.on_line = lambda: monkeypatch.setattr(MockRobot, "read", faulty)
    with pytest.raises(RobotFault):
        run(experiment, TypedName(console))


def test_mocks_and_loopback_are_asked_nothing(dwell_run: Path) -> None:
    start = content(dwell_run / "start.json")
    assert start["packages"]
    assert "confirmation" not in start  # it was run where no terminal was there to ask at


@pytest.mark.thorough
def test_in_python_naming_the_robot_is_the_confirmation(
    real: object, experiment: hil.Experiment
) -> None:
    runs = experiment.folder / "runs"
    with pytest.raises(NotConfirmed) as refused:
        hil.run(experiment, runs=runs)
    assert "robot='ur5'" in refused.value.hint
    report = hil.run(experiment, runs=runs, robot="ur5", operator="anna")
    answer = document(report)["confirmation"]
    assert (answer["how"], answer["by"]) == ("robot=", "anna")


def test_another_robot_than_the_experiments_is_a_mistake_also_on_a_mock(
    experiment: hil.Experiment,
) -> None:
    with pytest.raises(SpecError, match="'ur10' is not the robot of small"):
        hil.run(experiment, runs=experiment.folder / "runs", robot="ur10")


@pytest.mark.thorough
def test_a_run_that_goes_on_as_it_was_confirmed_asks_nothing(real: object, begun: Path) -> None:
    resumed = hil.resume(begun, desk=desk(Unconfirmed()))
    assert resumed.outcome == "completed"
    assert "confirmation" not in document(resumed, "resume-01.json")


@pytest.mark.thorough
def test_a_run_that_goes_on_at_another_address_asks_again(
    real: Callable[[str], None], begun: Path
) -> None:
    real(ELSEWHERE)
    with pytest.raises(NotConfirmed, match=ELSEWHERE):
        hil.resume(begun, desk=desk(Unconfirmed()))
    assert not (begun / "resume-01.json").exists()
    resumed = hil.resume(begun, desk=desk(TypedName(FakeConsole("ur5"), "bert")))
    answer = document(resumed, "resume-01.json")["confirmation"]
    assert (answer["by"], answer["facts"]["address"]) == ("bert", ELSEWHERE)


@pytest.mark.thorough
def test_the_newest_confirmation_counts(real: Callable[[str], None], begun: Path) -> None:
    resume = {"confirmation": {"facts": content(begun / "start.json")["confirmation"]["facts"]}}
    resume["confirmation"]["facts"]["address"] = ELSEWHERE
    (begun / "resume-01.json").write_text(json.dumps(resume))
    with pytest.raises(NotConfirmed):
        hil.resume(begun, desk=desk(Unconfirmed()))
    real(ELSEWHERE)
    assert hil.resume(begun, desk=desk(Unconfirmed())).outcome == "completed"


@pytest.mark.thorough
def test_a_run_that_goes_on_with_an_arm_that_was_jogged_asks_again(
    real: object, begun: Path
) -> None:
    jogged(begun)
    with pytest.raises(
        NotConfirmed, match=r"changed since the earlier confirmation: shoulder_pan.* moves"
    ) as no:
        hil.resume(begun)
    assert "robot='ur5'" in no.value.hint
    assert not (begun / "resume-01.json").exists()
    console = FakeConsole("ur5")
    resumed = hil.resume(begun, desk=desk(TypedName(console)))
    assert any("not as confirmed" in line for line in console.shown)
    facts = document(resumed, "resume-01.json")["confirmation"]["facts"]
    assert facts["swept"]["joints"][0]["min_rad"] == pytest.approx(np.radians(-150))


@pytest.mark.thorough
def test_what_is_armed_goes_on_with_an_arm_that_was_jogged(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    armed = Granted("armed", "anna", {"robot": "ur5", "address": AT})
    report = stopped(experiment, monkeypatch, armed)
    jogged(report.run)
    resumed = hil.resume(report.run, desk=desk(armed))
    assert resumed.outcome == "completed"
    assert document(resumed, "resume-01.json")["confirmation"]["how"] == "armed"


@pytest.mark.thorough
@pytest.mark.parametrize("record", ["another payload", "none"])
def test_a_run_that_was_confirmed_for_another_payload_or_never_asks(
    real: object, begun: Path, record: str
) -> None:
    start = content(begun / "start.json")
    if record == "none":
        del start["confirmation"]
    else:
        start["confirmation"]["facts"]["loads"][0]["mass_kg"] = 0.5
    (begun / "start.json").write_text(json.dumps(start))
    with pytest.raises(NotConfirmed):
        hil.resume(begun, desk=desk(Unconfirmed()))
    assert hil.resume(begun, robot="ur5").outcome == "completed"


def joint(low: float, high: float) -> dict[str, Any]:
    return {"name": "elbow_joint", "min_rad": low, "max_rad": high}


def box(high: float) -> dict[str, list[float]]:
    return {"min_m": [0.0, 0.0, 0.0], "max_m": [high, high, high]}


FACTS: dict[str, Any] = {
    "experiment": "small",
    "robot": "ur5",
    "model": "ur5",
    "driver": "ur",
    "address": AT,
    "identity": "UR5, serial number 7",
    "loads": [{"mass_kg": 0.0, "com_m": [0.0, 0.0, 0.0]}],
    "speed_rad_s": 0.1,
    "swept": {"joints": [joint(-1.0, 1.0)], "tool": box(0.5), "elbow": box(0.3)},
    "checklist": [],
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"address": ELSEWHERE}, f"address was {AT}, is {ELSEWHERE}"),
        ({"loads": [{"mass_kg": 3.0, "com_m": [0, 0, 0.1]}]}, "loads was 0 kg, is 3 kg"),
        ({"speed_rad_s": 1.0}, "joint speed was 5.73°/s, is 57.3°/s"),
        (
            {"swept": FACTS["swept"] | {"joints": [joint(-1.5, 0.0)]}},
            "elbow_joint moves -86° to 0°, but -57° to 57° was confirmed",
        ),
        ({"swept": FACTS["swept"] | {"tool": box(0.6)}}, "the tool leaves the confirmed box"),
        ({"swept": FACTS["swept"] | {"joints": [joint(-0.5, 1.01)]}}, ""),
        ({"speed_rad_s": 0.01, "identity": "UR5, serial number 8"}, ""),
    ],
)
def test_what_was_confirmed_covers_less_motion_but_no_more(
    change: dict[str, Any], said: str
) -> None:
    assert "; ".join(differences(FACTS, FACTS | change)) == said


@pytest.mark.thorough
def test_facts_confirmed_on_a_form_move_that_robot_and_no_other(
    real: Callable[[str], None], experiment: hil.Experiment
) -> None:
    with planned(experiment) as (robot, plan, _):
        facts = motion_confirmation.motion_facts(experiment, robot, plan).to_dict()
    file = experiment.folder / "confirmed.json"
    file.write_text(json.dumps({"how": "dashboard", "by": "anna", "facts": facts}))
    answer = document(run(experiment, granted_in(file)))["confirmation"]
    assert (answer["how"], answer["by"]) == ("dashboard", "anna")
    real(ELSEWHERE)
    with pytest.raises(NotConfirmed, match=f"address was {AT}"):
        run(experiment, granted_in(file))


STEPS = [
    FACTS | {"experiment": "first"},
    FACTS
    | {
        "experiment": "second",
        "loads": [{"mass_kg": 5.0, "com_m": [0.0, 0.0, 0.1]}],
        "swept": FACTS["swept"] | {"joints": [joint(-2.0, 0.0)]},
        "speed_rad_s": 0.2,
    },
]


@pytest.mark.parametrize(
    ("step", "change", "said"),
    [
        (0, {}, ""),
        (1, {}, ""),
        (0, {"swept": STEPS[1]["swept"]}, "elbow_joint moves -115° to 0°"),
        (1, {"swept": FACTS["swept"] | {"joints": [joint(-2.0, 1.0)]}}, ""),
        (1, {"swept": FACTS["swept"] | {"joints": [joint(-6.0, 6.0)]}}, "elbow_joint moves"),
        (1, {"swept": FACTS["swept"] | {"elbow": box(1.0)}}, "the elbow leaves"),
        (0, {"loads": STEPS[1]["loads"]}, "loads was 0 kg, is 5 kg"),
        (1, {"loads": [{"mass_kg": 20.0, "com_m": [0, 0, 0]}]}, "loads was 5 kg, is 20 kg"),
        (0, {"speed_rad_s": 0.2}, "joint speed"),
        (1, {"address": ELSEWHERE}, "address was"),
        (1, {"experiment": "third"}, "the experiment third was not shown"),
    ],
)
def test_each_experiment_of_a_series_is_compared_with_its_own_facts(
    tmp_path: Path, step: int, change: dict[str, Any], said: str
) -> None:
    file = tmp_path / "confirmed.json"
    answer = {"how": "dashboard", "by": "anna", "facts": facts_of_all(STEPS)}
    file.write_text(json.dumps(answer))
    facts = SimpleNamespace(robot="ur5", to_dict=lambda: STEPS[step] | change)
    granted = granted_in(file)
    granted.admit("ur5", AT)
    with pytest.raises(NotConfirmed, match=said) if said else nullcontext():
        granted(facts, lambda: None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"how": "dashboard", "by": "anna", "facts": {"robot": "ur5"}}',
        '{"how": "h", "by": "b", "facts": {"robot": "r", "address": "a", "motions": [{}]}}',
    ],
)
def test_a_file_that_names_no_robot_and_address_confirms_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / "confirmed.json").write_text(text)
    with pytest.raises(DataError):
        granted_in(tmp_path / "confirmed.json")


def test_a_run_that_is_started_gets_the_facts_that_were_confirmed(
    experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def begin(command: list[str], log: Path) -> subprocess.Popen[bytes]:
        commands.append(command)
        return subprocess.Popen(["true"])

    monkeypatch.setattr(background_runs, "begin", begin)
    runs = experiment.folder / "runs"
    background_runs.start_run(Path(experiment.spec_source), runs, operator="anna", confirmed=FACTS)
    (option,) = [word for word in commands[0] if word.startswith("--confirmed=")]
    granted = granted_in(Path(option.removeprefix("--confirmed=")))
    assert (granted.how, granted.who, granted.facts) == ("dashboard", "anna", FACTS)


def command(experiment: hil.Experiment, *words: str) -> int:
    given = ["run", experiment.spec_source, "--runs", str(experiment.folder / "runs"), *words]
    ended = CliRunner().invoke(app, given)
    return exit_code_of(ended.exception) if ended.exception else ended.exit_code


@pytest.mark.thorough
def test_the_command_line_needs_yes_where_there_is_no_terminal(
    real: object, experiment: hil.Experiment
) -> None:
    assert command(experiment) == 3
    assert not (experiment.folder / "runs").exists()
    assert command(experiment, "--yes") == 0
    (start,) = experiment.folder.glob("runs/*/*/*/start.json")
    assert json.loads(start.read_text("utf-8"))["confirmation"]["how"] == "--yes"


@pytest.mark.thorough
def test_the_command_line_takes_what_was_confirmed_elsewhere(
    real: object, experiment: hil.Experiment
) -> None:
    file = experiment.folder / "confirmed.json"
    facts = {"robot": "ur5", "address": ELSEWHERE}
    file.write_text(json.dumps({"how": "dashboard", "by": "anna", "facts": facts}))
    assert command(experiment, "--confirmed", str(file)) == 3
    file.write_text(file.read_text().replace(ELSEWHERE, AT))
    assert command(experiment, "--confirmed", str(file)) == 0


# Schedules, series and fleets: a real robot is named with its address, and confirmed once


ONE_ROBOT = (
    "hil_station: 1\nrobots:\n  ur5: {driver: mock, model: ur5, checklist: [Look around.]}\n"
)
NAMED = {"robots": {"ur5": AT}}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A schedule and a series of one robot, in the working folder."""
    monkeypatch.chdir(tmp_path)
    write_schedule(tmp_path, schedule=SCHEDULE | NAMED)
    (tmp_path / "station.yaml").write_text(ONE_ROBOT, "utf-8")
    write_series(tmp_path, NAMED)
    return tmp_path


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> Callable[..., FakeConsole]:
    """Put somebody at the terminal who types lines."""

    def so(*lines: str) -> FakeConsole:
        console = FakeConsole(*lines)
        monkeypatch.setattr(arming, "Console", lambda: console)
        return console

    return so


def write_series(folder: Path, more: dict[str, Any], *specs: str) -> None:
    entries = [{"spec": spec} for spec in specs or ("probe.yaml", "campaign.yaml")]
    document = {"hil_series": 1, "name": "both", "series": entries, **more}
    (folder / "series.yaml").write_text(json.dumps(document), "utf-8")


def called(*words: object) -> Result:
    """Run the command line, and raise its error."""
    done = CliRunner().invoke(app, [*map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


def nothing_moved(folder: Path) -> bool:
    return not list(folder.glob("runs/*/*/*"))


def confirmations(folder: Path) -> list[dict[str, Any]]:
    """Return those of all runs, oldest first."""
    starts = sorted(folder.glob("runs/*/ur5/*/start.json"))
    return [json.loads(path.read_text("utf-8"))["confirmation"] for path in starts]


@pytest.mark.parametrize(
    "words", [("schedule", "run", "weekly.yaml", "--once"), ("reidentify", "weekly.yaml")]
)
def test_a_schedule_that_is_not_armed_moves_no_real_robot(
    words: tuple[str, ...], real: object, folder: Path
) -> None:
    with pytest.raises(NotConfirmed, match=f"ur5 at {AT}, a real robot, and is not armed") as error:
        called(*words)
    assert "hil schedule arm weekly.yaml" in error.value.hint
    assert exit_code_of(error.value) == 3
    assert nothing_moved(folder)


@pytest.mark.thorough
def test_a_schedule_is_armed_once_by_the_name_of_its_robot(
    real: object, folder: Path, types: Callable[..., FakeConsole]
) -> None:
    console = types("ur5")
    armed = called("schedule", "arm", "weekly.yaml", "--operator", "anna").stdout
    assert f"armed for ur5 at {AT} by anna (typed" in " ".join(armed.split())
    shown = "\n".join(console.shown)
    for said in (AT, "payload", "speed", "Look around."):
        assert said in shown
    called("reidentify", "weekly.yaml")
    called("reidentify", "weekly.yaml", "--campaign")
    answers = confirmations(folder)
    assert len(answers) >= 2
    assert {(one["how"], one["by"]) for one in answers} == {("armed", "anna")}
    assert all(one["facts"]["address"] == AT for one in answers)


@pytest.mark.thorough
@pytest.mark.parametrize("typed", ["", "ur", "yes"])
def test_another_answer_arms_nothing(
    typed: str, real: object, folder: Path, types: Callable[..., FakeConsole]
) -> None:
    types(typed)
    with pytest.raises(NotConfirmed):
        called("schedule", "arm", "weekly.yaml")
    assert not (folder / "schedules" / "weekly" / ARMED_FILE).exists()


@pytest.mark.thorough
def test_without_a_terminal_nothing_is_armed_but_by_yes(real: object, folder: Path) -> None:
    with pytest.raises(NotConfirmed, match="no terminal is attached"):
        called("schedule", "arm", "weekly.yaml")
    done = json.loads(called("schedule", "arm", "weekly.yaml", "--yes", "--json").stdout)["armed"]
    assert done["how"] == "--yes"
    assert done["robots"] == {"ur5": AT}
    record = json.loads((folder / "schedules" / "weekly" / ARMED_FILE).read_text("utf-8"))
    assert record == done
    assert [one["robot"] for one in record["facts"]] == ["ur5", "ur5"]


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text("utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new), "utf-8")

    return change


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (edit("weekly.yaml", '"7d"', '"6d"'), "since: schedule file"),
        (edit("station.yaml", "Look around.", "Look."), "since: entry of ur5 in the station"),
        (edit("campaign.yaml", '"seed": 7', '"seed": 8'), "since: experiment campaign"),
        (
            edit("probe.yaml", '"robot": "ur5"', '"robot": "ur5", "loads": [{"mass_kg": 2}]'),
            "since: experiment probe",
        ),
    ],
    ids=["file", "station", "motion", "payload"],
)
def test_what_has_changed_needs_arming_again(
    change: Callable[[Path], None], words: str, real: object, folder: Path
) -> None:
    called("schedule", "arm", "weekly.yaml", "--yes")
    assert "armed for ur5" in called("schedule", "show", "weekly.yaml").stdout
    change(folder)
    with pytest.raises(NotConfirmed, match=words):
        called("reidentify", "weekly.yaml")
    shown = " ".join(called("schedule", "show", "weekly.yaml").stdout.split())
    assert f"{words}; arm it again" in shown
    assert nothing_moved(folder)
    called("schedule", "arm", "weekly.yaml", "--yes")
    moves = bind_file(folder / "weekly.yaml").moves(folder / "weekly.yaml")
    confirm = require_armed(moves, folder / "schedules" / "weekly")
    assert confirm is not None
    confirm.admit("ur5", AT)


@pytest.mark.thorough
@pytest.mark.parametrize("verb", [("validate",), ("reidentify",), ("schedule", "arm")])
@pytest.mark.parametrize(
    ("named", "words"),
    [({}, "the file does not name it"), ({"robots": {"ur5": ELSEWHERE}}, f"has {ELSEWHERE}")],
)
def test_the_schedule_names_robot_and_address(
    verb: tuple[str, ...], named: dict[str, Any], words: str, real: object, folder: Path
) -> None:
    write_schedule(folder, schedule=SCHEDULE | named)
    with pytest.raises(SpecError, match=words) as error:
        called(*verb, "weekly.yaml")
    assert f'robots: {{ur5: "{AT}"}}' in error.value.hint
    assert nothing_moved(folder)


@pytest.mark.thorough
def test_mocks_need_neither_names_nor_arming(folder: Path) -> None:
    write_schedule(folder)
    assert "needs no arming" in called("schedule", "arm", "weekly.yaml").stdout
    assert "armed" not in called("schedule", "show", "weekly.yaml").stdout
    called("reidentify", "weekly.yaml")
    write_series(folder, {}, "probe.yaml")
    called("run", "series.yaml")


@pytest.mark.thorough
def test_a_series_is_confirmed_at_its_start_for_all_runs(
    real: object, folder: Path, types: Callable[..., FakeConsole]
) -> None:
    console = types("ur5")
    called("run", "series.yaml", "--operator", "anna")
    assert sum("type ur5 to move" in line for line in console.shown) == 1
    assert [(one["how"], one["by"]) for one in confirmations(folder)] == [("typed", "anna")] * 2


@pytest.mark.thorough
def test_a_series_without_the_name_of_its_robot_moves_nothing(
    real: object, folder: Path, types: Callable[..., FakeConsole]
) -> None:
    types("no")
    with pytest.raises(NotConfirmed, match="nothing has moved"):
        called("run", "series.yaml")
    write_series(folder, {"robots": {"ur5": ELSEWHERE}})
    for verb in ("run", "validate"):
        with pytest.raises(SpecError, match=f"at {AT} .*has {ELSEWHERE}"):
            called(verb, "series.yaml")
    assert nothing_moved(folder)


def fleet(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command of a fleet whose arms say that they are real ones."""
    info = folder / "real_arm-1.dist-info"
    info.mkdir(exist_ok=True)
    (folder / "real_arm.py").write_text(REAL_ARM)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: real-arm\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[hil.drivers]\nreal-arm = real_arm:RealArm\n")
    entries = "".join(
        f"  arm-{k}: {{driver: real-arm, model: ur5, options: {{at: 198.51.100.{k}}}}}\n"
        for k in (1, 2)
    )
    (folder / "station.yaml").write_text(f"hil_station: 1\nrobots:\n{entries}")
    (folder / "small.yaml").write_text(MEMBER)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "hil", "fleet", *map(str, words)],
        cwd=folder, env=os.environ | {"PYTHONPATH": path}, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip


@pytest.mark.wire
def test_a_fleet_names_its_robots_in_a_file_and_is_confirmed_at_its_start(tmp_path: Path) -> None:
    begin = ("run", "small.yaml", "--station", "station.yaml", "--robots")
    unnamed = fleet(tmp_path, *begin, "arm-*", "--yes")
    assert unnamed.returncode == 2
    assert "arm-1 is a real robot at 198.51.100.1" in unnamed.stderr
    (tmp_path / "arms.yaml").write_text(
        "hil_fleet: 1\nrobots: {arm-1: 198.51.100.1, arm-2: 198.51.100.2}\n"
    )
    unasked = fleet(tmp_path, *begin, "arms.yaml")
    assert unasked.returncode == 3, unasked.stderr
    assert nothing_moved(tmp_path)
    done = fleet(tmp_path, *begin, "arms.yaml", "--yes", "--operator", "anna")
    assert done.returncode == 0, done.stderr
    starts = sorted(tmp_path.glob("runs/*/arm-*/*/start.json"))
    answers = [json.loads(path.read_text("utf-8"))["confirmation"] for path in starts]
    assert [(one["by"], one["facts"]["address"]) for one in answers] == [
        ("anna", "198.51.100.1"),
        ("anna", "198.51.100.2"),
    ]


POSES = "q1,q2,q3,q4,q5,q6\n10,-90,60,-60,-90,0\n15,-90,65,-60,-90,0\n20,-90,70,-60,-90,0\n"
DWELL = {
    "hil": 1, "name": "poses", "robot": "ur5", "warm_up": {"duration_s": 0},
    "weigh": {"poses": 0}, "accept": {"gaps_percent": {"max": 50}},
    "excitation": {"kind": "dwell", "file": "poses.csv", "file_unit": "deg"},
}  # fmt: skip


@pytest.fixture
def of_poses(folder: Path) -> Experiment:
    """An experiment of the station that takes its poses from a file."""
    (folder / "poses.csv").write_text(POSES, "utf-8")
    (folder / "poses.yaml").write_text(json.dumps(DWELL), "utf-8")
    return load_experiment(folder / "poses.yaml")


def scheduled(folder: Path, **experiments: Experiment) -> Moves:
    return Moves(folder / "weekly.yaml", NAMED["robots"], experiments)


def change_poses(folder: Path) -> None:
    (folder / "poses.csv").write_text(POSES.replace("70", "90"), "utf-8")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (change_poses, "experiment campaign"),
        (lambda folder: (folder / "state" / ARMED_FILE).unlink(), "is not armed"),
        (edit("weekly.yaml", "7d", "6d"), "schedule file"),
    ],
    ids=["poses", "disarmed", "file"],
)
def test_a_running_schedule_is_compared_with_its_record_before_each_motion(
    change: Callable[[Path], None], words: str, real: object, folder: Path, of_poses: Experiment
) -> None:
    moves = scheduled(folder, campaign=of_poses)
    arm(moves, folder / "state", yes=True)
    confirm = require_armed(moves, folder / "state")
    assert confirm is not None
    with planned(of_poses) as (robot, plan, _):
        facts = motion_facts(of_poses, robot, plan)
    confirm.admit("ur5", AT)
    assert confirm(facts, lambda: None)["how"] == "armed"
    change(folder)
    with pytest.raises(NotConfirmed, match=words):
        confirm.admit("ur5", AT)
    with pytest.raises(NotConfirmed, match=words):
        confirm(facts, lambda: None)


@pytest.mark.thorough
def test_a_disarmed_schedule_does_not_go_on_with_a_run_that_was_cut_off(
    real: object, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = folder / "schedules" / "weekly"
    called("schedule", "arm", "weekly.yaml", "--yes")
    bound = bind_file(folder / "weekly.yaml")
    confirm = require_armed(bound.moves(folder / "weekly.yaml"), state)
    assert confirm is not None
    monkeypatch.setattr(reidentifying, "run_of", lambda *told: folder / "cut-off")
    monkeypatch.setattr(reidentifying, "_require_harmless_end", lambda run: None)
    (state / ARMED_FILE).unlink()
    with pytest.raises(NotConfirmed, match="is not armed"):
        reidentifying.Measuring(folder / "runs", confirm=confirm).measure(bound.campaign, "weekly")


@pytest.mark.thorough
@pytest.mark.parametrize("changed", ["probe", "campaign"])
def test_probe_and_campaign_of_one_name_are_both_compared(
    changed: str, real: object, folder: Path
) -> None:
    for part, content in (("probe", PROBE), ("campaign", CAMPAIGN)):
        (folder / f"{part}.yaml").write_text(json.dumps(content | {"name": "same"}), "utf-8")

    def moves() -> Moves:
        parts = ("probe", "campaign")
        return scheduled(folder, **{one: load_experiment(folder / f"{one}.yaml") for one in parts})

    arm(moves(), folder / "state", yes=True)
    edit(f"{changed}.yaml", '"trajectories": ', '"trajectories": 1')(folder)
    with pytest.raises(NotConfirmed, match=f"experiment {changed}"):
        require_armed(moves(), folder / "state")


def test_another_arm_description_is_another_motion(
    real: object, folder: Path, of_poses: Experiment
) -> None:
    text = (Path(hil.arms.__file__).parent / "ur5.yaml").read_text("utf-8")
    own = folder / "arm.yaml"
    own.write_text(text, "utf-8")
    entry = of_poses.robot.model_copy(update={"model": str(own)})
    of_own = replace(of_poses, robot=entry)
    moves = scheduled(folder, campaign=of_own)
    confirm = confirm_together(moves, yes=True).begin(of_own)
    confirm.admit("ur5", AT)
    own.write_text(text.replace("qd_max_deg_s: 180", "qd_max_deg_s: 91"), "utf-8")
    description._parsed.cache_clear()  # as in another process
    with pytest.raises(NotConfirmed, match="arm description of ur5"):
        confirm.admit("ur5", AT)


def test_a_run_of_a_series_is_compared_with_what_was_confirmed(
    real: object, folder: Path, of_poses: Experiment
) -> None:
    moves = scheduled(folder, **{"series.0": of_poses})
    confirm = confirm_together(moves, yes=True).begin(of_poses)
    confirm.admit("ur5", AT)
    with pytest.raises(NotConfirmed, match=ELSEWHERE):
        confirm.admit("ur5", ELSEWHERE)
    change_poses(folder)
    with pytest.raises(NotConfirmed, match="experiment"):
        confirm.admit("ur5", AT)


def test_yes_moves_no_robot_whose_driver_opened_only_after_the_confirmation(
    real: object, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_series(folder, {})
    confirm = arming.confirm_together

    def closed(*name_and_entry: object) -> object:
        raise SpecError("the port is taken")

    def confirmed(*moves: Any, **how: Any) -> Together:
        monkeypatch.setattr(arming, "opened", closed)
        together = confirm(*moves, **how)
        monkeypatch.setattr(arming, "opened", opened)
        return together

    monkeypatch.setattr(arming, "confirm_together", confirmed)
    with pytest.raises(NotConfirmed, match="was not confirmed when series"):
        called("run", "series.yaml", "--yes")
    assert not confirmations(folder)


@pytest.mark.parametrize(
    ("how", "named", "moves"), [("--yes", AT, True), ("--yes", "", False), ("typed", AT, False)]
)
def test_a_run_of_a_series_is_gone_on_with_by_yes_where_the_file_names_its_robot(
    how: str, named: str, moves: bool
) -> None:
    together = Together(Path("series.yaml"), {"ur5": named} if named else {}, how, "anna", ())
    confirm = together.resume("ur5", Path("runs/1"))
    if moves:
        confirm.admit("ur5", AT)
    for address in (ELSEWHERE,) if moves else (AT, ELSEWHERE):
        with pytest.raises(NotConfirmed):
            confirm.admit("ur5", address)


@pytest.mark.thorough
def test_the_facts_say_that_the_way_to_the_first_pose_is_not_included(
    real: object, folder: Path, types: Callable[..., FakeConsole]
) -> None:
    for verb in (("schedule", "arm", "weekly.yaml"), ("run", "series.yaml")):
        console = types("no")
        with pytest.raises(NotConfirmed):
            called(*verb)
        shown = "\n".join(console.shown)
        assert "the motion from the present pose to the first pose is not included" in shown


def test_a_real_robot_without_an_address_cannot_be_named(
    real: Callable[[str], None], folder: Path, of_poses: Experiment
) -> None:
    real("unknown")
    moves = Moves(folder / "series.yaml", {"ur5": "unknown"}, {"series.0": of_poses})
    with pytest.raises(SpecError, match="'mock' does not state an address") as error:
        moves.real()
    assert "HasAddress" in error.value.hint
