"""What could only fail at night is refused when a schedule is read: all of it at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import plugins
from hil.core.errors import SpecError
from hil.estimators.base import estimator
from hil.maintenance.binding import Bound, bind
from hil.maintenance.simulation import with_options
from hil.spec.load import load_station
from hil.spec.schedule import load_schedule_spec
from tests.support.pipeline_parts import CAMPAIGN, FOURIER, PROBE, SCHEDULE, write_schedule


def bound(folder: Path, **changed: Any) -> Bound:
    return bind(load_schedule_spec(write_schedule(folder, **changed)))


def problems(folder: Path, **changed: Any) -> list[str]:
    with pytest.raises(SpecError) as told:
        bound(folder, **changed)
    return told.value.message.splitlines()


def test_a_schedule_is_bound_to_its_experiments(tmp_path: Path) -> None:
    found = bound(tmp_path)
    assert (found.name, found.fit.estimator) == ("ur5", "rigid-wls")
    assert [one.spec.name for one in found.experiments] == ["probe", "campaign"]


def test_the_estimator_is_the_one_that_is_named(tmp_path: Path) -> None:
    both = CAMPAIGN | {"fit": [{"estimator": "rigid-hysteresis"}, {"estimator": "rigid-wls"}]}
    assert bound(tmp_path, campaign=both).fit.estimator == "rigid-hysteresis"
    named = SCHEDULE | {"campaign": {"spec": "campaign.yaml", "estimator": "rigid-wls"}}
    assert bound(tmp_path, campaign=both, schedule=named).fit.estimator == "rigid-wls"
    named = SCHEDULE | {"campaign": {"spec": "campaign.yaml", "estimator": "static-wls"}}
    (told,) = problems(tmp_path, campaign=both, schedule=named)
    assert told == "campaign.estimator: campaign fits rigid-hysteresis, rigid-wls, not 'static-wls'"


def test_a_campaign_needs_one_model(tmp_path: Path) -> None:
    none = {key: value for key, value in CAMPAIGN.items() if key not in ("fit", "validate")}
    assert problems(tmp_path, campaign=none) == [
        "campaign.spec: campaign has no `fit`: there would be no model"
    ]
    twice = CAMPAIGN | {"fit": [{"estimator": "rigid-wls"}, {"estimator": "rigid-wls"}]}
    assert "fits rigid-wls 2 times" in "".join(problems(tmp_path, campaign=twice))


def test_a_model_of_a_papers_protocol_is_never_champion(tmp_path: Path) -> None:
    leaky = {"estimator": "static-wls", "form": "paper", "current_term": True}
    dwell = {"kind": "dwell", "waypoints": 40}
    parts = {"validate": {"hold_out": {"poses_percent": 20}}, "fit": [leaky]}
    paper = CAMPAIGN | parts | {"excitation": dwell | {"seed": 7}}
    probe = PROBE | {"excitation": dwell | {"seed": 21}}
    (told,) = problems(tmp_path, campaign=paper, probe=probe)
    assert told.startswith("campaign.estimator: the model of static-wls is not honest")


def test_a_probe_is_of_the_same_robot_and_of_another_motion(tmp_path: Path) -> None:
    other = PROBE | {"robot": "ur3"}
    (told,) = problems(tmp_path, probe=other)
    assert "probe.spec: drives ur3" in told
    assert "a probe tells nothing of another robot" in told
    same = PROBE | {"excitation": FOURIER | {"seed": 7, "trajectories": 4}}
    (told,) = problems(tmp_path, probe=same)
    assert "its motion is that of the campaign" in told


def test_a_probe_that_says_too_little_is_refused(tmp_path: Path) -> None:
    short = PROBE | {"excitation": FOURIER | {"seed": 21, "trajectories": 3}}
    (told,) = problems(tmp_path, probe=short)
    assert "3 trajectories of 5 s say too little: make them 20 s together" in told
    # Blocks are of whole trajectories: 21 s in three of 7 s are three blocks.
    odd = FOURIER | {"seed": 21, "trajectories": 3, "fundamental_hz": 1 / 7}
    assert len(problems(tmp_path, probe=PROBE | {"excitation": odd})) == 1
    twice = FOURIER | {"seed": 21, "trajectories": 2, "periods": 2}
    more = CAMPAIGN | {"validate": {"hold_out": {"trajectories": 2}}}
    assert bound(tmp_path, probe=PROBE | {"excitation": twice}, campaign=more)


def test_a_schedule_that_could_never_compare_two_models_is_refused(tmp_path: Path) -> None:
    alone = SCHEDULE | {"probe": None, "campaign": {"spec": "campaign.yaml", "every": "7d"}}
    (told,) = problems(tmp_path, schedule=alone)
    assert told.startswith(
        "campaign.spec: what campaign holds out makes 1 different blocks of 5 s to compare two "
        "models on, and 4 are needed"
    )
    more = CAMPAIGN | {"validate": {"hold_out": {"trajectories": 4}}}
    assert bound(tmp_path, schedule=alone, campaign=more)
    # The second period comes by the same places.
    longer = FOURIER | {"seed": 7, "trajectories": 5, "periods": 2}
    two = {"excitation": longer, "validate": {"hold_out": {"trajectories": 2}}}
    (told,) = problems(tmp_path, schedule=alone, campaign=CAMPAIGN | two)
    assert "makes 2 different blocks" in told
    # Of loads alone every trajectory is held out.
    loads = {"loads": [{"mass_kg": 0}, {"mass_kg": 2}], "validate": {"hold_out": {"loads": [1]}}}
    assert bound(tmp_path, schedule=alone, campaign=CAMPAIGN | loads)


def test_a_model_that_does_not_tell_friction_apart_is_no_champion_of_probes(tmp_path: Path) -> None:
    dwell = {"kind": "dwell", "waypoints": 40}
    parts = {"fit": [{"estimator": "static-wls"}], "validate": {"hold_out": {"poses_percent": 20}}}
    still = CAMPAIGN | parts | {"excitation": dwell | {"seed": 7}}
    probe = PROBE | {"excitation": dwell | {"seed": 21}}
    (told,) = problems(tmp_path, campaign=still, probe=probe)
    assert told.startswith("campaign.estimator: static-wls does not tell friction apart")
    alone = {"probe": None, "campaign": {"spec": "campaign.yaml", "every": "7d"}}
    assert bound(tmp_path, schedule=SCHEDULE | alone, campaign=still)


@pytest.mark.parametrize(
    "name", [name for name in plugins.names("hil.estimators") if not name.startswith("test")]
)
def test_estimators_say_whether_they_tell_friction_apart(name: str) -> None:
    silent = {"static-wls", "static-linear", "static-inverse"}
    assert estimator(name).tells_friction is (name not in silent)


def test_nobody_answers_at_night(tmp_path: Path) -> None:
    asks = CAMPAIGN | {"loads": [{"mass_kg": 0}, {"mass_kg": 2, "prompt": "Mount 2 kg"}]}
    assert bound(tmp_path, campaign=asks)  # a mock on a virtual clock mounts by itself
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": {"clock": "wall"}}}
    station = {"hil_station": 1, "robots": robots}
    (tmp_path / "station.yaml").write_text(json.dumps(station), "utf-8")
    (told,) = problems(tmp_path, campaign=asks)
    assert told.startswith("campaign.spec: campaign asks for something to be done ('Mount 2 kg')")


def test_hil_validate_says_all_at_once_with_their_places(tmp_path: Path) -> None:
    broken = PROBE | {"robot": "ur3", "excitation": FOURIER | {"seed": 7, "trajectories": 1}}
    none = {key: value for key, value in CAMPAIGN.items() if key not in ("fit", "validate")}
    file = write_schedule(tmp_path, probe=broken, campaign=none)
    told = CliRunner().invoke(app, ["validate", str(file)])
    lines = str(told.exception).splitlines()
    assert told.exit_code
    assert len([line for line in lines if line.startswith(str(file))]) == 4
    assert f"{file}:9:11: campaign.spec: " in str(told.exception)


def test_hil_validate_of_a_file_that_cannot_be_read_says_what_is_wrong_there(tmp_path) -> None:
    file = write_schedule(tmp_path, campaign=CAMPAIGN | {"warmup": 3}, probe=PROBE | {"hil": 9})
    told = str(CliRunner().invoke(app, ["validate", str(file)]).exception)
    assert "campaign.yaml" in told
    assert "did you mean 'warm_up'" in told
    assert "probe.yaml" in told


def test_hil_validate_tells_what_a_schedule_would_do(tmp_path: Path) -> None:
    file = write_schedule(tmp_path)
    told = json.loads(CliRunner().invoke(app, ["validate", str(file), "--json"]).stdout)
    assert told["valid"] is True
    assert (told["model"], told["estimator"]) == ("ur5", "rigid-wls")
    assert [run["name"] for run in told["runs"]] == ["probe", "campaign"]
    text = CliRunner().invoke(app, ["validate", str(file)]).stdout
    assert f"{file}: valid (models of ur5, rigid-wls)" in text


def test_other_options_are_also_in_the_copy_of_the_station(tmp_path: Path) -> None:
    experiment = bound(tmp_path).campaign
    other = with_options(experiment, {"day": 3, "seed": 4})
    assert other.robot.options == {"day": 3, "seed": 4}
    copy = tmp_path / "copy.yaml"
    copy.write_text(other.station_text, "utf-8")
    assert load_station(copy).robots["ur5"] == other.robot
    assert (other.spec, other.station_source) == (experiment.spec, experiment.station_source)
    assert not experiment.robot.options
