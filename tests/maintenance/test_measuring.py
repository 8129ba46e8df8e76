"""A run belongs to its occasion: made once, gone on with where a crash or a signal has cut it."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import PreflightFailed, RobotError
from hil.estimators import estimator
from hil.maintenance.reidentifying import Measuring, run_of
from hil.maintenance.simulation import with_options
from hil.models.model_registry import facts_of
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from hil.recording.run_directory import RunDirectory
from tests.support.pipeline_parts import CAMPAIGN, PROBE, write_schedule
from tests.support.synthetic_motion import moving, nominal


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
