"""Re-identification: what is done when it is due, in which order, and with which runs.

Four runs are made once, of one mock: a campaign, a probe, and both again when a joint has worn.
Occasions here take them as they are instead of moving.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.errors import (
    DataError,
    FitError,
    HilError,
    PreflightFailed,
    RecordingError,
    RobotError,
)
from hil.estimators import estimator
from hil.maintenance import reidentifying
from hil.maintenance.binding import bind
from hil.maintenance.ledger import Job
from hil.maintenance.reidentifying import (
    MOST,
    Measuring,
    Reidentification,
    as_it_is,
    earlier_probes,
    reidentification,
    run_of,
)
from hil.maintenance.simulation import with_options
from hil.maintenance.stages import FOLDER, Document, Stage, run_stages, stored_result
from hil.models.drift import Probe, charted_probes
from hil.models.drift_features import Features
from hil.models.model_registry import Registry, facts_of
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from hil.recording.run_directory import RunDirectory
from hil.spec.schedule import ScheduleSpec, load_schedule_spec
from tests.support.pipeline_parts import CAMPAIGN, PROBE, occasion, write_schedule
from tests.support.plans_once import share_plans
from tests.support.synthetic_motion import moving, nominal

# What is done when something is due, and what never is


WORN = {"wear": [1.0, 1.6, 1.0, 1.0, 1.0, 1.0]}
Run = Callable[[str], Path]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """`campaign`, `probe`, `worn campaign`, `worn probe`, a `short campaign` fitted to 5 s, and a
    probe of an `other probe` program."""
    home = tmp_path_factory.mktemp("recorded")
    bound = bind(load_schedule_spec(write_schedule(home)))
    assert bound.probe is not None
    measuring = Measuring(home / "runs")
    short = CAMPAIGN | {
        "excitation": CAMPAIGN["excitation"] | {"trajectories": 2, "seed": 9},
        "validate": {"hold_out": {"trajectories": 1}},
    }
    few = bind(load_schedule_spec(write_schedule(home / "short", campaign=short))).campaign
    edited = PROBE | {"excitation": PROBE["excitation"] | {"seed": 22}}
    other = bind(load_schedule_spec(write_schedule(home / "edited", probe=edited))).probe
    assert other is not None
    wanted = {
        "campaign": with_options(bound.campaign, {"day": 1}),
        "probe": with_options(bound.probe, {"day": 2}),
        "worn campaign": with_options(bound.campaign, {"day": 3} | WORN),
        "worn probe": with_options(bound.probe, {"day": 4} | WORN),
        "short campaign": with_options(few, {"day": 5}),
        "other probe": with_options(other, {"day": 6}),
    }
    with pytest.MonkeyPatch.context() as patch:
        share_plans(patch)  # a worn robot has the same ones
        return {name: measuring.measure(one, f"weekly/{name}") for name, one in wanted.items()}


@dataclass(slots=True)
class Taken:
    """In place of `Measuring`: runs that were made before."""

    runs: dict[str, Path]
    meanwhile: dict[str, Callable[[], object]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def measure(self, experiment: Experiment, named: str) -> Path:
        """The run that stands for this stage."""
        stage = named.rpartition("/")[2]
        self.asked.append(stage)
        self.meanwhile.get(stage, lambda: None)()
        return self.runs[stage]


@dataclass(slots=True)
class Robot:
    """A robot whose runs are taken from what was recorded, with a registry of its own."""

    home: Path
    recorded: dict[str, Path]
    registry: Registry
    campaign: dict[str, Any] = field(default_factory=lambda: dict(CAMPAIGN))
    schedule: dict[str, Any] = field(default_factory=dict)
    taken: Taken = field(default_factory=lambda: Taken({}))
    meanwhile: dict[str, Callable[[], object]] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)

    def due(self, week: int, job: Job = "probe", **runs: str) -> dict[str, Any]:
        """An occasion with these runs; probes and campaigns are as good as new by default."""
        named = {"probe": "probe", "campaign": "campaign", "check": "probe"} | runs
        runs_of = {stage: self.recorded[name] for stage, name in named.items()}
        self.taken = Taken(runs_of, self.meanwhile)
        told = {"hil_schedule": 1, "name": "weekly", "probe": {"spec": "probe.yaml", "every": "7d"},
                "campaign": {"spec": "campaign.yaml"}} | self.schedule  # fmt: skip
        file = write_schedule(self.home, PROBE, self.campaign, told)
        bound = bind(load_schedule_spec(file))
        measuring: Any = self.taken
        self.told = []
        work = Reidentification(bound, self.registry, measuring, as_it_is, self.told.append)
        due = occasion(week, job)
        return work(due, self.home / due.id)


@pytest.fixture
def robot(tmp_path: Path, recorded) -> Robot:
    return Robot(tmp_path, recorded, Registry(tmp_path / "registry"))


@pytest.fixture
def drifted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every probe is called changed, as after weeks of quiet ones."""

    _judged(monkeypatch, changed=True)


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """No probe is called changed, such as when a robot changes too little."""
    _judged(monkeypatch, changed=False)


def _judged(monkeypatch: pytest.MonkeyPatch, *, changed: bool) -> None:
    class Judged:
        def to_dict(self) -> dict[str, Any]:
            return {"changed": changed, "text": "friction up on J2", "causes": [], "features": {}}

    monkeypatch.setattr("hil.maintenance.reidentifying.assess", lambda *given, **named: Judged())


def events(robot: Robot) -> list[tuple[str, int]]:
    return [(entry.event, entry.version) for entry in robot.registry.log("ur5")]


@pytest.mark.thorough
def test_the_first_model_is_champion_without_a_probe(robot: Robot) -> None:
    told = robot.due(0)
    assert robot.taken.asked == ["campaign"]
    assert robot.told == ["campaign", "fit", "register", "challenge"]
    assert (told["outcome"], told["before"], told["champion"]) == ("promoted", None, "v1")

    assert told["text"] == "v1 is champion: first campaign: there are no criteria"
    assert told["errors"] is None
    assert events(robot) == [("registered", 1), ("challenger", 1), ("promoted", 1)]


@pytest.mark.thorough
def test_a_quiet_probe_starts_nothing(robot: Robot) -> None:
    robot.due(0)
    told = robot.due(1)
    assert robot.taken.asked == ["probe"]
    assert robot.told == ["probe", "drift"]  # and nothing of what is left out
    assert (told["outcome"], told["champion"], told["decision"]) == ("quiet", "v1", None)
    assert told["errors"]["before"] == told["errors"]["after"]
    assert len(events(robot)) == 3


@pytest.mark.thorough
def test_a_probe_is_compared_with_those_of_its_own_program(robot: Robot) -> None:
    """Along another motion a model errs otherwise, which is no change of the robot."""
    robot.due(0)
    robot.due(1)
    edited = robot.due(2, probe="other probe")
    assert edited["drift"]["reference"] == 0
    assert edited["text"].startswith("probe 1 of this program under this champion: nothing")
    worn = robot.due(3, probe="worn probe")
    assert worn["drift"]["reference"] == 1
    bands = charted_probes(robot.registry, "ur5")
    assert [one.chart.reference for one in bands] == [0, 0, 1]


@pytest.mark.thorough
@pytest.mark.usefixtures("drifted")
def test_a_change_is_identified_and_the_challenger_promoted(robot: Robot) -> None:
    robot.due(0)
    told = robot.due(1, probe="worn probe", campaign="worn campaign", check="worn probe")
    assert robot.taken.asked == ["probe", "campaign", "check"]
    assert robot.told == ["probe", "drift", "campaign", "fit", "register", "check", "challenge"]
    assert (told["outcome"], told["before"], told["champion"]) == ("promoted", "v1", "v2")
    words = "v2 is champion: friction up on J2: the challenger's error is smaller"
    assert told["text"].startswith(words)
    assert told["errors"]["after"][1] < 0.7 * told["errors"]["before"][1]
    compared = told["decision"]["evidence"]["comparison"]
    assert len(compared["sources"]) == 3
    assert set(told["runs"]) == {"probe", "campaign", "check"}
    assert robot.registry.aliases("ur5").champion == 2


@pytest.mark.thorough
@pytest.mark.usefixtures("drifted")
def test_a_change_is_only_told_where_it_shall_not_start_a_campaign(robot: Robot) -> None:
    robot.due(0)
    robot.schedule = {"campaign": {"spec": "campaign.yaml", "on_drift": False}}
    told = robot.due(1)
    assert robot.taken.asked == ["probe"]
    assert (told["outcome"], told["text"]) == ("drift", "friction up on J2")


@pytest.mark.thorough
def test_a_campaign_that_is_due_needs_no_change(robot: Robot) -> None:
    robot.due(0)
    told = robot.due(1, "campaign", campaign="worn campaign")
    assert robot.taken.asked == ["probe", "campaign", "check"]
    assert told["drift"]["changed"] is False
    assert told["challenger"] == "v2"


WORN_RUNS = {"probe": "worn probe", "campaign": "worn campaign", "check": "worn probe"}


@pytest.mark.thorough
def test_a_robot_that_is_as_it_was_is_predicted_as_it_was(
    robot: Robot, request: pytest.FixtureRequest
) -> None:
    """On one day the challenger errs less for sure; on the day before it erred more."""
    robot.due(0)
    robot.due(1)
    request.getfixturevalue("unseen")
    told = robot.due(2, "campaign", **WORN_RUNS)
    assert (told["outcome"], told["champion"]) == ("kept", "v1")
    assert "error is smaller: " in told["text"]
    assert ", but over 2 days " in told["text"]
    evidence = told["decision"]["evidence"]
    assert evidence["comparison"]["better"] is True
    assert evidence["days"]["differences"][0] < 0 < evidence["days"]["differences"][1]


@pytest.mark.thorough
def test_what_a_robot_did_before_it_changed_is_no_matter(
    robot: Robot, request: pytest.FixtureRequest
) -> None:
    robot.due(0)
    robot.due(1)
    request.getfixturevalue("drifted")
    told = robot.due(2, **WORN_RUNS)
    assert (told["outcome"], told["champion"]) == ("promoted", "v2")
    assert "days" not in told["decision"]["evidence"]


@pytest.mark.thorough
def test_another_champion_is_not_the_one_that_was_to_be_compared_with(robot: Robot) -> None:
    robot.due(0)
    assert robot.due(1, "campaign", **WORN_RUNS)["champion"] == "v2"
    back = lambda: robot.registry.roll_back("ur5", reason="by hand")  # noqa: E731
    robot.meanwhile = {"check": back}
    told = robot.due(2, "campaign", campaign="short campaign", **{"probe": "worn probe"})
    assert (told["outcome"], told["before"], told["champion"]) == ("kept", "v2", "v1")
    assert told["text"] == (
        "v3 is not promoted, v1 stays champion: it is due: "
        "v1 has become champion instead of v2 in the meantime"
    )
    assert events(robot)[-2:] == [("rolled-back", 1), ("kept", 3)]


@pytest.mark.thorough
def test_a_probe_is_held_against_the_champion_of_its_occasions_beginning(robot: Robot) -> None:
    robot.due(0)
    robot.due(1, "campaign", **WORN_RUNS)
    back = lambda: robot.registry.roll_back("ur5", reason="by hand")  # noqa: E731
    robot.meanwhile = {"probe": back}
    assert robot.due(2)["drift"]["champion"] == 2


@pytest.mark.thorough
def test_the_first_one_does_not_take_the_place_of_another_first_one(robot: Robot) -> None:
    (other,) = (robot.recorded["short campaign"] / "fit").iterdir()

    def promote() -> None:
        robot.registry.register("ur5", other, {})
        robot.registry.promote("ur5", 1, reason="by hand", evidence={}, instead_of=0)

    robot.meanwhile = {"campaign": promote}
    told = robot.due(0)
    assert (told["outcome"], told["before"], told["champion"]) == ("kept", None, "v1")
    assert told["text"].endswith("first campaign: v1 has become champion in the meantime")


@pytest.mark.thorough
@pytest.mark.usefixtures("drifted")
def test_a_challenger_that_errs_more_on_held_out_data_is_never_promoted(robot: Robot) -> None:
    """Fitted to a single trajectory of five seconds."""
    robot.due(0)
    told = robot.due(1, campaign="short campaign")
    assert (told["outcome"], told["champion"], told["challenger"]) == ("kept", "v1", "v2")
    assert told["text"].startswith("v2 is not promoted, v1 stays champion: friction up on J2: ")
    assert told["decision"]["evidence"]["comparison"]["worse"] is True
    assert events(robot)[-1] == ("kept", 2)
    assert robot.registry.aliases("ur5").to_dict() == {
        "champion": 1, "challenger": None, "before": [],
    }  # fmt: skip
    assert told["errors"]["after"] == told["errors"]["before"]


@pytest.mark.thorough
def test_the_first_model_has_to_meet_the_criteria(robot: Robot, missed: Run) -> None:
    robot.recorded = robot.recorded | {"campaign": missed("campaign")}
    told = robot.due(0)
    assert (told["outcome"], told["champion"]) == ("kept", None)
    assert (
        "1 criteria of the campaign are not met: nrmse of mean is 0.4, at most 0.3" in told["text"]
    )
    assert robot.registry.aliases("ur5").champion == 0


@pytest.mark.thorough
def test_a_challenger_that_misses_the_criteria_is_not_compared(robot: Robot, missed: Run) -> None:
    robot.due(0)
    robot.recorded = robot.recorded | {"worn campaign": missed("worn campaign")}
    told = robot.due(1, "campaign", probe="worn probe", campaign="worn campaign")
    assert (told["outcome"], told["champion"]) == ("kept", "v1")
    assert "criteria" in told["text"]


@pytest.mark.thorough
def test_without_its_model_a_campaign_says_why(robot: Robot, tmp_path: Path, recorded) -> None:
    import shutil

    run = shutil.copytree(recorded["campaign"], tmp_path / "broken")
    shutil.rmtree(run / "fit")
    robot.recorded = robot.recorded | {"campaign": run}
    with pytest.raises(FitError, match="has no model of rigid-wls: it was removed"):
        robot.due(0)


@pytest.mark.thorough
def test_the_champion_does_not_challenge_itself(robot: Robot) -> None:
    robot.due(0)
    told = robot.due(1, "campaign")
    assert (told["outcome"], told["champion"]) == ("kept", "v1")
    assert "it is the champion already" in told["text"]
    assert events(robot) == [("registered", 1), ("challenger", 1), ("promoted", 1)]


@pytest.mark.thorough
@pytest.mark.parametrize("lost", ["register", "challenge", "summary"])
@pytest.mark.parametrize(("campaign", "event"), [("worn", "promoted"), ("short", "kept")])
def test_what_a_crash_has_not_noted_is_not_done_twice(
    robot: Robot, lost: str, campaign: str, event: str
) -> None:
    robot.due(0)
    probe = "worn probe" if campaign == "worn" else "probe"
    runs = {"probe": probe, "campaign": f"{campaign} campaign", "check": probe}
    told = robot.due(1, "campaign", **runs)
    before = events(robot)
    assert before[-1] == (event, 2)
    (robot.home / occasion(1, "campaign").id / FOLDER / f"{lost}.json").unlink()
    assert robot.due(1, "campaign", **runs) == told
    assert robot.taken.asked == []
    assert events(robot) == before


@pytest.mark.thorough
def test_another_occasion_decides_for_itself(robot: Robot) -> None:
    """The same model again, kept once: the log has a decision of each occasion."""
    robot.due(0)
    for week in (1, 2):
        robot.due(week, "campaign", campaign="short campaign")
    assert [one for one in events(robot) if one[0] == "kept"] == [("kept", 2)] * 2


def test_an_experiment_may_differ_by_occasion_and_stage(tmp_path: Path) -> None:
    class Seen(HilError):
        """Instead of a motion."""

    told = []

    def adapt(experiment: Experiment, due: Any, stage: str) -> Experiment:
        told.append((experiment.spec.name, due.id, stage))
        raise Seen("")

    spec: ScheduleSpec = load_schedule_spec(write_schedule(tmp_path))
    registry = Registry(tmp_path / "registry")
    work = reidentification(spec, registry=registry, runs=tmp_path / "runs", adapt=adapt)
    with pytest.raises(Seen):
        work(occasion(0), tmp_path / "state")
    assert told == [("campaign", "20270102T030000Z-probe", "campaign")]


@pytest.fixture
def missed(tmp_path: Path, recorded) -> Run:
    """A copy of a recorded run whose model has missed a criterion."""
    import json
    import shutil

    def made(name: str) -> Path:
        run = Path(shutil.copytree(recorded[name], tmp_path / f"missed {name}"))
        verdict = json.loads((run / "verdict.json").read_bytes())
        verdict["rows"] = [{"estimator": "rigid-wls", "metric": "nrmse", "per": "mean",
                            "what": "mean", "value": 0.4, "max": 0.3, "unit": "1",
                            "passed": False}]  # fmt: skip
        (run / "verdict.json").write_text(json.dumps(verdict), "utf-8")
        return run

    return made


# Stages are done once for what they are made from, in the order of their needs


class Work:
    """Three stages, one after the other; notes which of them are done."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.inputs: dict[str, dict[str, Any]] = {"a": {}, "b": {}, "c": {}}

    def stages(self) -> list[Stage]:
        return [
            Stage("c", self._do("c"), ("b",), self.inputs["c"]),
            Stage("b", self._do("b"), ("a",), self.inputs["b"]),
            Stage("a", self._do("a"), (), self.inputs["a"]),
        ]

    def _do(self, name: str) -> Any:
        def do(before: Mapping[str, Document]) -> Document:
            self.done.append(name)
            return {"name": name, "before": {key: one["name"] for key, one in before.items()}}

        return do


@pytest.fixture
def work() -> Work:
    return Work()


def test_stages_are_done_in_the_order_of_needs_and_see_what_they_need(work, tmp_path) -> None:
    told = run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c"]
    assert told["c"] == {"name": "c", "before": {"b": "b"}}
    assert stored_result(tmp_path, "c") == told["c"]


def test_what_is_done_is_not_done_again(work, tmp_path) -> None:
    first = run_stages(work.stages(), tmp_path)
    assert run_stages(work.stages(), tmp_path) == first
    assert work.done == ["a", "b", "c"]


def test_other_inputs_make_a_stage_and_all_after_it_anew(work, tmp_path) -> None:
    run_stages(work.stages(), tmp_path)
    work.inputs["b"] = {"share": 0.1}
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c", "b", "c"]


def test_a_file_counts_with_its_content(work, tmp_path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text("one", "utf-8")
    work.inputs["c"] = {"spec": file}
    run_stages(work.stages(), tmp_path)
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c"]
    file.write_text("two", "utf-8")
    run_stages(work.stages(), tmp_path)
    assert work.done == ["a", "b", "c", "c"]


@pytest.mark.parametrize("damage", ["torn", "changed", "no JSON"])
def test_a_damaged_document_is_made_anew(work, tmp_path, damage) -> None:
    told = run_stages(work.stages(), tmp_path)
    path = tmp_path / FOLDER / "b.json"
    text = path.read_text("utf-8")
    changed = text.replace('"name": "b"', '"name": "x"')
    damaged = {"torn": text[:-20], "changed": changed, "no JSON": "[]"}
    path.write_text(damaged[damage], "utf-8")
    assert stored_result(tmp_path, "b") is None
    assert run_stages(work.stages(), tmp_path) == told
    # It comes to the same, so that nothing after it is touched.
    assert work.done == ["a", "b", "c", "b"]


def test_a_stage_that_fails_leaves_those_before_it(work, tmp_path) -> None:
    def fails(before: Mapping[str, Document]) -> Document:
        raise DataError("nothing there")

    stages = [*work.stages(), Stage("d", fails, ("c",))]
    for _ in range(2):
        with pytest.raises(DataError, match="nothing there"):
            run_stages(stages, tmp_path)
    assert work.done == ["a", "b", "c"]


def test_a_document_is_the_same_the_first_time_as_read_back(tmp_path) -> None:
    def do(before: Mapping[str, Document]) -> Document:
        return {"tuple": (1, 2), "nan": float("nan"), "path": Path("x"), 3: "three"}

    first = run_stages([Stage("a", do)], tmp_path)
    assert first == run_stages([Stage("a", do)], tmp_path)
    assert first["a"] == {"tuple": [1, 2], "nan": None, "path": "x", "3": "three"}
    assert json.loads((tmp_path / FOLDER / "a.json").read_bytes())["stage"] == "a"


def test_needs_that_cannot_be_are_refused(work, tmp_path) -> None:
    with pytest.raises(ValueError, match="there is no stage a"):
        run_stages(work.stages()[:2], tmp_path)
    around = [Stage("a", dict, ("b",)), Stage("b", dict, ("a",))]
    with pytest.raises(ValueError, match="stages depend on each other: "):
        run_stages(around, tmp_path)
    with pytest.raises(ValueError, match="same name"):
        run_stages([Stage("a", dict), Stage("a", dict)], tmp_path)


def test_a_folder_that_cannot_be_written_is_told(work, tmp_path) -> None:
    (tmp_path / FOLDER).write_text("in the way", "utf-8")
    with pytest.raises(RecordingError, match="cannot write"):
        run_stages(work.stages(), tmp_path)


# Which probes of the weeks before a challenger has to err less on, too


def probe(folder: Path, day: int, champion: int = 1, *, changed: bool = False) -> Probe:
    """Of a day; its recording is a file."""
    source = folder / f"{day:02d}.mcap"
    source.write_bytes(b"")
    nothing = np.zeros(0)
    told = Features((), nothing, nothing, nothing, nothing, 0, np.eye(0), np.zeros((1, 0)))
    at = f"2026-11-{day:02d}T03:00:00+00:00"
    return Probe(
        str(day), at, str(source), "", champion, 0.01, told, changed, (), 0.5, 5
    )  # fmt: skip


@pytest.fixture
def days(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """The days that are looked at, given the history; today is the 28th."""

    def found(*probes: Probe) -> list[str]:
        monkeypatch.setattr(reidentifying, "probes_of", lambda registry, name: list(probes))
        registry = Registry(tmp_path)
        return [path.stem for path in earlier_probes(registry, "ur5", tmp_path / "28.mcap")]

    return found


def test_the_last_ones_before_today_whoever_was_champion(
    tmp_path: Path, days: Callable[..., list[str]]
) -> None:
    history = [probe(tmp_path, day, champion=1 + day // 24) for day in range(20, 29)]
    assert days(*history) == ["27", "26", "25", "24", "23"]
    assert MOST == 5


def test_as_far_back_as_nothing_has_changed(tmp_path: Path, days: Callable[..., list[str]]) -> None:
    history = [probe(tmp_path, day, changed=day == 25) for day in (24, 25, 26, 27, 28)]
    assert days(*history) == ["27", "26"]


def test_one_probe_under_two_champions_is_one_and_changed_if_either_says_so(
    tmp_path: Path, days: Callable[..., list[str]]
) -> None:
    twice = probe(tmp_path, 26)
    again = replace(twice, champion=2)
    assert days(probe(tmp_path, 25), twice, again, probe(tmp_path, 28)) == ["26", "25"]
    changed = replace(twice, champion=2, changed=True)
    assert days(probe(tmp_path, 25), changed, twice, probe(tmp_path, 27)) == ["27"]


def test_what_was_pruned_is_left_out(tmp_path: Path, days: Callable[..., list[str]]) -> None:
    gone, there = probe(tmp_path, 26), probe(tmp_path, 27)
    Path(gone.source).unlink()
    run = tmp_path / "run"
    (run / "recording").mkdir(parents=True)
    assert days(probe(tmp_path, 25), gone, there) == ["27", "25"]
    assert days(replace(gone, source=str(run)), there) == ["27"]
    (run / "recording" / "00.mcap").write_bytes(b"")
    assert days(replace(gone, source=str(run)), there) == ["27", "run"]


# A run belongs to its occasion: made once, gone on with where a crash or a signal has cut it


@dataclass(frozen=True)
class Place:
    """A folder with one run of `probe`, made for the occasion `weekly/1/probe`."""

    runs: Path
    run: Path
    probe: Experiment

    def measure(self, occasion: str = "weekly/1/probe") -> Path:
        return Measuring(self.runs).measure(self.probe, occasion)

    def count(self) -> int:
        return len(list(self.runs.glob("*/*/*/start.json")))

    def end(self, **changed: object) -> None:
        """Make the run end otherwise, before it was judged."""
        stop = self.run / "stop.json"
        document = json.loads(stop.read_bytes()) | changed
        stop.write_text(json.dumps(document), "utf-8")
        (self.run / "verdict.json").unlink()

    def die(self, *last: dict[str, Any]) -> None:
        """Lose the process that makes the run, after these events."""
        self.end()
        (self.run / "stop.json").unlink()
        events = self.run / "events.jsonl"
        lines = events.read_text("utf-8").splitlines(keepends=True)
        kept = [line for line in lines if json.loads(line).get("state") not in ("stopping", "done")]
        events.write_text("".join(kept + [json.dumps(one) + "\n" for one in last]), "utf-8")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("made")
    write_schedule(home)
    probe = load_experiment(home / "probe.yaml")
    Measuring(home / "runs").measure(probe, "weekly/1/probe")
    return home


@pytest.fixture
def place(made: Path, tmp_path: Path) -> Place:
    runs = Path(shutil.copytree(made / "runs", tmp_path / "runs"))
    (run,) = runs.glob("*/*/*")
    return Place(runs, run, load_experiment(made / "probe.yaml"))


@pytest.mark.thorough
def test_a_run_says_what_occasion_it_is_for(place: Place) -> None:
    assert RunDirectory.open(place.run).start["occasion"] == "weekly/1/probe"
    assert run_of(place.runs, place.probe, "weekly/1/probe") == place.run
    assert run_of(place.runs, place.probe, "weekly/1/prob") is None
    assert run_of(place.runs, place.probe, "weekly/1") is None


def test_a_complete_run_is_taken_as_it_is(place: Place) -> None:
    before = sorted(place.run.rglob("*"))
    assert place.measure() == place.run
    assert sorted(place.run.rglob("*")) == before
    assert place.count() == 1


def test_a_page_that_a_crash_has_kept_is_made(place: Place) -> None:
    (place.run / "report.html").unlink()
    assert place.measure() == place.run
    assert (place.run / "report.html").is_file()


@pytest.mark.thorough
def test_another_spec_is_another_run(made: Path, place: Place, tmp_path: Path) -> None:
    changed = PROBE | {"excitation": PROBE["excitation"] | {"trajectories": 1}}
    write_schedule(tmp_path, probe=changed)
    other = load_experiment(tmp_path / "probe.yaml")
    run = Measuring(place.runs).measure(other, "weekly/1/probe")
    assert run != place.run
    assert place.count() == 2


@pytest.mark.thorough
@pytest.mark.parametrize("how", ["killed", "by signal", "before the verdict"])
def test_a_run_that_was_cut_off_is_gone_on_with(place: Place, how: str) -> None:
    ends: dict[str, object] = {"outcome": "stopped", "exit_code": 130, "reason": "SIGTERM"}
    place.end(**(ends if how == "by signal" else {}))
    if how == "killed":
        (place.run / "stop.json").unlink()
    assert place.measure() == place.run
    assert (place.run / "verdict.json").is_file()
    assert place.count() == 1


@pytest.mark.thorough
def test_what_is_missing_of_a_run_is_measured(place: Place, tmp_path: Path) -> None:
    place.end()
    (place.run / "stop.json").unlink()
    (recording,) = (place.run / "recording").iterdir()
    content = recording.read_bytes()
    recording.rename(torn := recording.with_name("00.mcap.partial"))
    torn.write_bytes(content[: len(content) // 2])
    assert place.measure() == place.run
    assert RunDirectory.open(place.run).attempts == 2
    assert (place.run / "verdict.json").is_file()
    model = estimator("rigid-wls").fit(moving(1, 2, 3), nominal()).save(tmp_path / "model")
    learned_from = facts_of(model, [place.run])["data_sha256"]
    assert sorted(learned_from) == ["recording/00.mcap.partial", "recording/01.mcap"]


@pytest.mark.parametrize(("outcome", "exit_code"), [("tripped", 5), ("failed", 4), ("stopped", 6)])
def test_nobody_goes_on_alone_with_what_did_not_end_by_chance(
    place: Place, outcome: str, exit_code: int
) -> None:
    """An interlock, a fault or somebody's hand: it takes a look before the arm moves again."""
    place.end(outcome=outcome, exit_code=exit_code, reason="it touched something")
    with pytest.raises(RobotError, match=f"was {outcome}: it touched something"):
        place.measure()
    assert RunDirectory.open(place.run).attempts == 1
    assert not (place.run / "verdict.json").exists()


@pytest.mark.parametrize(
    ("last", "why"),
    [
        ({"kind": "trip", "reason": "it touched something"}, "tripped: it touched something"),
        ({"kind": "hung", "reason": "no return"}, "tripped: no return"),
        ({"kind": "state", "state": "stopping", "reason": "fault 7"}, "stopped: fault 7"),
        ({"kind": "state", "state": "stopping", "reason": "stopped by Ada"}, "stopped by Ada"),
    ],
)
def test_nor_with_what_had_ended_so_when_the_process_died(
    place: Place, last: dict[str, str], why: str
) -> None:
    """The power that fails a moment after a trip does not take the trip back."""
    place.die(last)
    with pytest.raises(RobotError, match=why):
        place.measure()
    assert RunDirectory.open(place.run).attempts == 1


def test_what_somebody_has_gone_on_with_since_is_gone_on_with(place: Place) -> None:
    place.die({"kind": "trip", "reason": "smoke"}, {"kind": "state", "state": "preflight"})
    assert place.measure() == place.run
    assert (place.run / "verdict.json").is_file()


def test_a_process_that_died_of_a_second_signal_was_ended_by_a_signal(place: Place) -> None:
    ended = {"kind": "state", "state": "stopping", "reason": "stopped by SIGTERM"}
    place.die(ended | {"by_signal": True})
    assert place.measure() == place.run


@pytest.mark.thorough
def test_another_robot_is_another_run(place: Place, tmp_path: Path) -> None:
    """Two stations, one folder of runs, one schedule: due at the same second."""
    text = place.probe.station_text
    elsewhere = replace(place.probe, station_source="/elsewhere/station.yaml", station_text=text)
    changed = with_options(place.probe, {"seed": 3})
    assert run_of(place.runs, elsewhere, "weekly/1/probe") is None
    assert run_of(place.runs, changed, "weekly/1/probe") is None
    run = Measuring(place.runs).measure(changed, "weekly/1/probe")
    assert run != place.run
    assert run_of(place.runs, changed, "weekly/1/probe") == run
    assert run_of(place.runs, place.probe, "weekly/1/probe") == place.run


def test_an_arm_that_was_replaced_does_not_take_over_the_run(place: Place) -> None:
    start = json.loads((place.run / "start.json").read_bytes())
    start["robot"]["identity"]["serial"] = "the arm before"
    (place.run / "start.json").write_text(json.dumps(start), "utf-8")
    with pytest.raises(PreflightFailed, match="serial was 'the arm before'"):
        place.measure()


@pytest.mark.thorough
def test_a_run_that_asks_for_somebody_is_refused_before_it_begins(tmp_path: Path) -> None:
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": {"clock": "wall"}}}
    station = json.dumps({"hil_station": 1, "robots": robots})
    asks = CAMPAIGN | {"loads": [{"mass_kg": 2, "prompt": "Mount 2 kg"}]}
    write_schedule(tmp_path, campaign=asks)
    (tmp_path / "station.yaml").write_text(station, "utf-8")
    experiment = load_experiment(tmp_path / "campaign.yaml")
    with pytest.raises(PreflightFailed, match="no console to answer"):
        Measuring(tmp_path / "runs").measure(experiment, "weekly/1/campaign")
    assert not list(tmp_path.glob("runs/*/*/*"))
