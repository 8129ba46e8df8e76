"""A run belongs to its occasion: made once, gone on with where a crash or a signal has cut it."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
from pipeline_parts import CAMPAIGN, PROBE, write_schedule
from synthetic_motion import moving, nominal

from hil.campaign.experiment import Experiment, load_experiment
from hil.errors import PreflightFailed, RobotError
from hil.identify import estimator
from hil.pipeline.measuring import Measuring, run_of
from hil.record.rundir import RunDirectory
from hil.registry.facts import facts_of


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


def test_another_spec_is_another_run(made: Path, place: Place, tmp_path: Path) -> None:
    changed = PROBE | {"excitation": PROBE["excitation"] | {"trajectories": 1}}
    write_schedule(tmp_path, probe=changed)
    other = load_experiment(tmp_path / "probe.yaml")
    run = Measuring(place.runs).measure(other, "weekly/1/probe")
    assert run != place.run
    assert place.count() == 2


@pytest.mark.parametrize("how", ["killed", "by signal", "before the verdict"])
def test_a_run_that_was_cut_off_is_gone_on_with(place: Place, how: str) -> None:
    ends: dict[str, object] = {"outcome": "stopped", "exit_code": 130, "reason": "SIGTERM"}
    place.end(**(ends if how == "by signal" else {}))
    if how == "killed":
        (place.run / "stop.json").unlink()
    assert place.measure() == place.run
    assert (place.run / "verdict.json").is_file()
    assert place.count() == 1


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


def test_a_run_that_asks_for_somebody_is_refused_before_it_begins(tmp_path: Path) -> None:
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": {"clock": "wall"}}}
    station = json.dumps({"hil_station": 1, "robots": robots})
    asks = CAMPAIGN | {"loads": [{"mass_kg": 2, "prompt": "Mount 2 kg"}]}
    write_schedule(tmp_path, campaign=asks)
    (tmp_path / "station.yaml").write_text(station, "utf-8")
    experiment = load_experiment(tmp_path / "campaign.yaml")
    with pytest.raises(PreflightFailed, match="nobody could answer"):
        Measuring(tmp_path / "runs").measure(experiment, "weekly/1/campaign")
    assert not list(tmp_path.glob("runs/*/*/*"))
