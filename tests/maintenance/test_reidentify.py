"""What is done when something is due, and what never is.

Four runs are made once, of one mock: a campaign, a probe, and both again when a joint has worn.
Occasions here take them as they are instead of moving.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import FitError, HilError
from hil.maintenance.binding import bind
from hil.maintenance.ledger import Job
from hil.maintenance.reidentifying import Measuring, Reidentification, as_it_is, reidentification
from hil.maintenance.simulation import with_options
from hil.maintenance.stages import FOLDER
from hil.models.drift import charted_probes
from hil.models.model_registry import Registry
from hil.planning.experiment import Experiment
from hil.spec.schedule import ScheduleSpec, load_schedule_spec
from tests.support.pipeline_parts import CAMPAIGN, PROBE, occasion, write_schedule

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
    assert told["text"] == "v1 is champion: the first one: there are no criteria"
    assert told["errors"] is None
    assert events(robot) == [("registered", 1), ("challenger", 1), ("promoted", 1)]


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
    assert told["text"].startswith("v2 is champion: friction up on J2: the challenger errs less")
    assert told["errors"]["after"][1] < 0.7 * told["errors"]["before"][1]
    compared = told["decision"]["evidence"]["comparison"]
    assert len(compared["sources"]) == 3
    assert set(told["runs"]) == {"probe", "campaign", "check"}
    assert robot.registry.aliases("ur5").champion == 2


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
    assert "errs less: " in told["text"]
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
        "v3 is not promoted, v1 stays: it is due: v1 has become champion meanwhile, instead of v2"
    )
    assert events(robot)[-2:] == [("rolled-back", 1), ("kept", 3)]


@pytest.mark.thorough
def test_a_probe_is_held_against_the_champion_of_its_occasions_beginning(robot: Robot) -> None:
    robot.due(0)
    robot.due(1, "campaign", **WORN_RUNS)
    back = lambda: robot.registry.roll_back("ur5", reason="by hand")  # noqa: E731
    robot.meanwhile = {"probe": back}
    assert robot.due(2)["drift"]["champion"] == 2


def test_the_first_one_does_not_take_the_place_of_another_first_one(robot: Robot) -> None:
    (other,) = (robot.recorded["short campaign"] / "fit").iterdir()

    def promote() -> None:
        robot.registry.register("ur5", other, {})
        robot.registry.promote("ur5", 1, reason="by hand", evidence={}, instead_of=0)

    robot.meanwhile = {"campaign": promote}
    told = robot.due(0)
    assert (told["outcome"], told["before"], told["champion"]) == ("kept", None, "v1")
    assert told["text"].endswith("the first one: v1 has become champion meanwhile")


@pytest.mark.thorough
@pytest.mark.usefixtures("drifted")
def test_a_challenger_that_errs_more_on_held_out_data_is_never_promoted(robot: Robot) -> None:
    """Fitted to a single trajectory of five seconds."""
    robot.due(0)
    told = robot.due(1, campaign="short campaign")
    assert (told["outcome"], told["champion"], told["challenger"]) == ("kept", "v1", "v2")
    assert told["text"].startswith("v2 is not promoted, v1 stays: friction up on J2: ")
    assert told["decision"]["evidence"]["comparison"]["worse"] is True
    assert events(robot)[-1] == ("kept", 2)
    assert robot.registry.aliases("ur5").to_dict() == {
        "champion": 1, "challenger": None, "before": [],
    }  # fmt: skip
    assert told["errors"]["after"] == told["errors"]["before"]


def test_the_first_model_has_to_meet_the_criteria(robot: Robot, missed: Run) -> None:
    robot.recorded = robot.recorded | {"campaign": missed("campaign")}
    told = robot.due(0)
    assert (told["outcome"], told["champion"]) == ("kept", None)
    assert (
        "1 criteria of the campaign are missed: nrmse of mean is 0.4, at most 0.3" in told["text"]
    )
    assert robot.registry.aliases("ur5").champion == 0


def test_a_challenger_that_misses_the_criteria_is_not_compared(robot: Robot, missed: Run) -> None:
    robot.due(0)
    robot.recorded = robot.recorded | {"worn campaign": missed("worn campaign")}
    told = robot.due(1, "campaign", probe="worn probe", campaign="worn campaign")
    assert (told["outcome"], told["champion"]) == ("kept", "v1")
    assert "criteria" in told["text"]


def test_without_its_model_a_campaign_says_why(robot: Robot, tmp_path: Path, recorded) -> None:
    import shutil

    run = shutil.copytree(recorded["campaign"], tmp_path / "broken")
    shutil.rmtree(run / "fit")
    robot.recorded = robot.recorded | {"campaign": run}
    with pytest.raises(FitError, match="has no rigid-wls: it was removed"):
        robot.due(0)


@pytest.mark.thorough
def test_the_champion_does_not_challenge_itself(robot: Robot) -> None:
    robot.due(0)
    told = robot.due(1, "campaign")
    assert (told["outcome"], told["champion"]) == ("kept", "v1")
    assert "it is the champion itself" in told["text"]
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
