"""A real robot moves only when its motion was confirmed; mocks and loopback ask nothing."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, NotConfirmed, RobotFault, SpecError, exit_code_of
from hil.engine import Engine, Reply, nobody_goes_on
from hil.planning.plan import Plan
from hil.robot import Address
from hil.workflow import background_runs, motion_confirmation
from hil.workflow.console import Console
from hil.workflow.motion_confirmation import (
    Granted,
    TypedName,
    Unconfirmed,
    differences,
    digest_of,
    facts_of_all,
    granted_in,
)
from hil.workflow.operator import OperatorChannel
from hil.workflow.preview import planned
from hil.workflow.running import RunReport
from hil_mock_robot.embedded.robot import MockRobot

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 2}
loads: [{mass_kg: 1.5, com_m: [0, 0, 0.05]}]
weigh: {poses: 0}
accept: {gaps_percent: {max: 50}}
"""
STATION = """
hil_station: 1
robots:
  ur5:
    driver: mock
    model: ur5
    checklist: [The emergency stop is within reach., Nobody is near.]
"""
AT, ELSEWHERE = "198.51.100.7", "198.51.100.8"


class FakeConsole(Console):
    """Types the given lines, one a look, and keeps what it is shown."""

    def __init__(self, *typed: str | None, there: bool = True) -> None:
        super().__init__()
        self.typed = list(typed)
        self.there = there
        self.shown: list[str] = []
        self.on_line: Callable[[], object] = lambda: None

    @property
    def present(self) -> bool:
        return self.there

    def forget_typed(self) -> None:
        """What was typed before does not count; nothing was."""

    def line(self, wait_s: float) -> str | None:
        self.on_line()
        return self.typed.pop(0) if self.typed else None

    def say(self, *paragraphs: str, ask: str = "") -> None:
        self.shown += [*paragraphs, ask]

    def show(self, lines: Iterable[str]) -> None:
        self.shown += lines


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """The embedded mock, declared to be a real arm at an address."""

    def at(address: str) -> None:
        monkeypatch.setattr(MockRobot, "address", Address(address))

    at(AT)
    return at


@pytest.fixture
def experiment(tmp_path: Path) -> hil.Experiment:
    (tmp_path / "small.yaml").write_text(SPEC, "utf-8")
    (tmp_path / "station.yaml").write_text(STATION, "utf-8")
    return hil.load(tmp_path / "small.yaml")


def desk(confirm: motion_confirmation.Confirm) -> OperatorChannel:
    return OperatorChannel(
        lambda text, meanwhile: Reply(True, "anna"), nobody_goes_on, confirm=confirm
    )


def run(experiment: hil.Experiment, confirm: motion_confirmation.Confirm) -> RunReport:
    return hil.run(experiment, runs=experiment.folder / "runs", desk=desk(confirm))


def document(report: RunReport, name: str = "start.json") -> dict[str, Any]:
    out: dict[str, Any] = json.loads((report.run / name).read_text("utf-8"))
    return out


def stopped(
    experiment: hil.Experiment,
    monkeypatch: pytest.MonkeyPatch,
    confirm: motion_confirmation.Confirm,
) -> RunReport:
    """A run that somebody stopped after its first measurements."""
    original = Engine._execute

    def stopping(engine: Engine, step: Any) -> None:
        if step.index == 8:
            engine.request_stop("the test wants it")
        original(engine, step)

    with monkeypatch.context() as patch:
        patch.setattr(Engine, "_execute", stopping)
        report = run(experiment, confirm)
    assert report.outcome == "stopped"
    return report


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
def test_its_name_moves_it_and_what_was_shown_is_recorded(
    real: object, experiment: hil.Experiment
) -> None:
    console = FakeConsole(None, "ur5")
    answer = document(run(experiment, TypedName(console, "anna")))["confirmation"]
    shown, facts = "\n".join(console.shown), answer["facts"]
    assert (answer["how"], answer["by"]) == ("typed", "anna")
    assert answer["digest"] == digest_of(facts)
    assert facts["address"] == AT
    assert facts["loads"] == [{"mass_kg": 1.5, "com_m": [0.0, 0.0, 0.05]}]
    assert facts["checklist"] == ["The emergency stop is within reach.", "Nobody is near."]
    for said in (AT, "1.5 kg at (0, 0, 50) mm", "wrist_3_joint", "elbow", "Nobody is near."):
        assert said in shown
    assert console.shown[-1].startswith("type ur5 to move")


@pytest.mark.thorough
def test_the_space_that_was_shown_is_that_of_the_plan_that_is_executed(
    real: object, experiment: hil.Experiment
) -> None:
    report = run(experiment, TypedName(FakeConsole("ur5")))
    plan = Plan.from_dict(document(report, "plan.json"))
    facts = document(report)["confirmation"]["facts"]
    assert facts["swept"]["duration_s"] == plan.duration_s
    assert [j["min_rad"] for j in facts["swept"]["joints"]] == plan.extremes.q_min.tolist()
    assert facts["speed_rad_s"] == plan.extremes.qd_max.max()


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


@pytest.mark.thorough
def test_mocks_and_loopback_are_asked_nothing(experiment: hil.Experiment) -> None:
    assert "confirmation" not in document(run(experiment, Unconfirmed()))


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
def test_a_run_that_goes_on_as_it_was_confirmed_asks_nothing(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = stopped(experiment, monkeypatch, Granted("--yes"))
    resumed = hil.resume(begun.run, desk=desk(Unconfirmed()))
    assert resumed.outcome == "completed"
    assert "confirmation" not in document(resumed, "resume-01.json")


@pytest.mark.thorough
def test_a_run_that_goes_on_at_another_address_asks_again(
    real: Callable[[str], None], experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = stopped(experiment, monkeypatch, Granted("--yes"))
    real(ELSEWHERE)
    with pytest.raises(NotConfirmed, match=ELSEWHERE):
        hil.resume(begun.run, desk=desk(Unconfirmed()))
    assert not (begun.run / "resume-01.json").exists()
    resumed = hil.resume(begun.run, desk=desk(TypedName(FakeConsole("ur5"), "bert")))
    answer = document(resumed, "resume-01.json")["confirmation"]
    assert (answer["by"], answer["facts"]["address"]) == ("bert", ELSEWHERE)


@pytest.mark.thorough
def test_the_newest_confirmation_counts(
    real: Callable[[str], None], experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = stopped(experiment, monkeypatch, Granted("--yes"))
    resume = {"confirmation": {"facts": document(begun)["confirmation"]["facts"]}}
    resume["confirmation"]["facts"]["address"] = ELSEWHERE
    (begun.run / "resume-01.json").write_text(json.dumps(resume))
    with pytest.raises(NotConfirmed):
        hil.resume(begun.run, desk=desk(Unconfirmed()))
    real(ELSEWHERE)
    assert hil.resume(begun.run, desk=desk(Unconfirmed())).outcome == "completed"


def jogged(run: Path) -> None:
    """Let the arm of a run stand where its program never takes it."""
    station = run / "station.yaml"
    options = "driver: mock\n    options: {start_q_deg: [-150, -60, -100, -60, 120, 170]}"
    station.write_text(station.read_text("utf-8").replace("driver: mock", options), "utf-8")


@pytest.mark.thorough
def test_a_run_that_goes_on_with_an_arm_that_was_jogged_asks_again(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = stopped(experiment, monkeypatch, Granted("--yes"))
    jogged(begun.run)
    with pytest.raises(NotConfirmed, match=r"not as confirmed before: shoulder_pan.* goes") as no:
        hil.resume(begun.run)
    assert "robot='ur5'" in no.value.hint
    assert not (begun.run / "resume-01.json").exists()
    console = FakeConsole("ur5")
    resumed = hil.resume(begun.run, desk=desk(TypedName(console)))
    assert any("not as confirmed" in line for line in console.shown)
    facts = document(resumed, "resume-01.json")["confirmation"]["facts"]
    assert facts["swept"]["joints"][0]["min_rad"] == pytest.approx(np.radians(-150))


@pytest.mark.thorough
def test_what_is_armed_goes_on_with_an_arm_that_was_jogged(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    armed = Granted("armed", "anna", {"robot": "ur5", "address": AT})
    begun = stopped(experiment, monkeypatch, armed)
    jogged(begun.run)
    resumed = hil.resume(begun.run, desk=desk(armed))
    assert resumed.outcome == "completed"
    assert document(resumed, "resume-01.json")["confirmation"]["how"] == "armed"


@pytest.mark.thorough
@pytest.mark.parametrize("record", ["another payload", "none"])
def test_a_run_that_was_confirmed_for_another_payload_or_never_asks(
    real: object, experiment: hil.Experiment, monkeypatch: pytest.MonkeyPatch, record: str
) -> None:
    begun = stopped(experiment, monkeypatch, Granted("--yes"))
    start = document(begun)
    if record == "none":
        del start["confirmation"]
    else:
        start["confirmation"]["facts"]["loads"][0]["mass_kg"] = 0.5
    (begun.run / "start.json").write_text(json.dumps(start))
    with pytest.raises(NotConfirmed):
        hil.resume(begun.run, desk=desk(Unconfirmed()))
    assert hil.resume(begun.run, robot="ur5").outcome == "completed"


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
            "elbow_joint goes -86° to 0°, confirmed were -57° to 57°",
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
        (0, {"swept": STEPS[1]["swept"]}, "elbow_joint goes -115° to 0°"),
        (1, {"swept": FACTS["swept"] | {"joints": [joint(-2.0, 1.0)]}}, ""),
        (1, {"swept": FACTS["swept"] | {"joints": [joint(-6.0, 6.0)]}}, "elbow_joint goes"),
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
