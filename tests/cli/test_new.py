"""`hil new`: what it writes is valid, says what it is about, and runs on the mock."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

import hil
from hil.arms import load_arm, model_sha256
from hil.arms.description import _parsed
from hil.cli.app import app
from hil.core.errors import DataError, SpecError
from hil.spec import load_spec, load_station
from hil.spec.documentation import COLUMN, WIDTH, commented, schema_files
from hil.spec.draft import DRAFT_KINDS
from hil.spec.experiment import ExperimentSpec
from hil.testing import PLUGIN_KINDS
from tests.support.paths import FILES

URDF = FILES / "own_arm.urdf"
EXPERIMENTS = ("dwell", "fourier", "load-sweep")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def told(*words: str) -> dict[str, list[str]]:
    document: dict[str, list[str]] = json.loads(invoke("new", *words, "--json").stdout)
    return document


def refused(*words: str) -> SpecError:
    error = invoke("new", *words).exception
    assert isinstance(error, SpecError)
    return error


def written(kind: str) -> list[Path]:
    more = ("--urdf", str(URDF)) if kind == "own-urdf" else ()
    return [Path(file) for file in told(kind, *more)["files"]]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", DRAFT_KINDS)
def test_everything_is_valid_and_names_a_schema_that_is_there(kind: str) -> None:
    files = [file for file in written(kind) if file.suffix == ".yaml"]
    for file in files:
        text = file.read_text()
        named = re.search(r"^# yaml-language-server: \$schema=(\S+)$", text, re.M)
        assert "@" not in text.replace("lab@example.org", "")
        if named is None:
            assert file.name.endswith("-arm.yaml")
        else:
            assert (file.parent / named[1]).read_text() == schema_files()[Path(named[1]).name]
    if kind == "station":
        load_station(files[0])
    else:
        station = ("--station", str(files[1])) if kind == "own-urdf" else ()
        assert invoke("validate", str(files[0]), *station).exit_code == 0


@pytest.mark.thorough
@pytest.mark.parametrize("kind", DRAFT_KINDS)
def test_comments_stay_in_their_column(kind: str) -> None:
    for file in written(kind):
        if file.suffix == ".yaml" and not file.name.endswith("-arm.yaml"):
            assert max(map(len, file.read_text().splitlines())) <= WIDTH


@pytest.mark.thorough
@pytest.mark.parametrize("kind", EXPERIMENTS)
def test_plans_are_made(kind: str) -> None:
    (file, *_) = written(kind)
    assert hil.plan(hil.load(file))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "fewer"),
    [
        ("dwell", {"excitation.waypoints": "12", "warm_up.duration_s": "2"}),
        ("fourier", {"excitation.trajectories": "4", "warm_up.duration_s": "2"}),
    ],
)
def test_programs_pass_on_the_mock(kind: str, fewer: dict[str, str]) -> None:
    (file, *_) = written(kind)
    report = hil.run(hil.load(file, overrides=fewer))
    assert (report.outcome, report.verdict) == ("completed", "passed")


@pytest.mark.thorough
def test_an_arm_of_ones_own_runs_as_a_mock() -> None:
    spec, station, arm, *_ = written("own-urdf")
    fewer = {"excitation.trajectories": "4", "warm_up.duration_s": "2"}
    report = hil.run(hil.load(spec, station, overrides=fewer))

    assert (report.outcome, report.verdict) == ("completed", "passed")
    start = json.loads((report.run / "start.json").read_text())
    assert start["robot"]["joint_names"] == ["A1", "A2", "A3", "A4", "A5", "A6"]
    assert start["robot"]["model"] == str(arm.resolve())
    # The run's own copy of the station is read from another folder.
    assert load_station(report.run / "station.yaml").robots["own_arm"].model == str(arm.resolve())


@pytest.mark.thorough
def test_a_run_goes_on_and_is_fitted_only_with_the_arm_it_was_recorded_with() -> None:
    spec, station, arm, *_ = written("own-urdf")
    fewer = {"excitation.trajectories": "3", "warm_up.duration_s": "1", "fit": "[]"}
    fewer |= {"validate": "{}", "accept": "{gaps_percent: {max: 1}}"}
    run = hil.run(hil.load(spec, station, overrides=fewer)).run
    recorded = json.loads((run / "start.json").read_text())["robot"]["model_sha256"]
    assert recorded == model_sha256(str(arm))

    text = arm.read_text()
    arm.write_text(text.replace("qdd_max, ", ""))  # looked up, and right as it was
    _parsed.cache_clear()
    assert len(hil.dataset(run))
    arm.write_text(text.replace("rate_hz: 250", "rate_hz: 251"))
    _parsed.cache_clear()
    told = f"{arm.resolve()} has changed since {run} was made"
    with pytest.raises(DataError, match=re.escape(told)):
        hil.resume(run)
    with pytest.raises(DataError, match=re.escape(told)):
        hil.fit(run, estimator="rigid-wls")
    assert hil.fit(run, estimator="rigid-wls", robot=str(arm))
    arm.unlink()
    _parsed.cache_clear()
    with pytest.raises(DataError, match="cannot be read as an arm"):
        hil.fit(run, estimator="rigid-wls")


def test_a_spec_whose_robot_is_at_a_station_beside_it_says_which(here: Path) -> None:
    spec, station, *_ = written("own-urdf")
    Path("other-station.yaml").write_text(station.read_text().replace("own_arm:", "left:"))
    Path("broken-station.yaml").write_text("a: [1")
    error = invoke("validate", str(spec)).exception
    assert isinstance(error, SpecError)
    assert error.hint == f"use the station beside the spec: --station {station}"
    assert invoke("validate", str(spec), "--station", str(station)).exit_code == 0

    missed = invoke("validate", str(spec), "--station", "other-station.yaml").exception
    assert isinstance(missed, SpecError)
    assert "did you mean" not in missed.hint or "left" in missed.hint


@pytest.mark.parametrize("robot", ["lab6", "panda", "lab6_can"])
def test_an_own_arm_is_not_called_as_a_built_in_one(robot: str) -> None:
    Path(f"{robot}.urdf").write_text(URDF.read_text())
    words = ("own-urdf", "--urdf", f"{robot}.urdf")
    error = refused(*words)
    assert f"'{robot}' is the name of a built-in robot" in error.message
    assert [path.name for path in Path().iterdir()] == [f"{robot}.urdf"]
    option = error.hint.partition(": ")[2].split()
    assert told(*words, *option)["files"][0] == f"my-{robot}.yaml"


@pytest.mark.parametrize("verb", ["validate", "plan", "run"])
def test_a_built_in_robot_in_place_of_that_of_a_station_beside_is_told(
    verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def enough(*_: object) -> None:
        raise SpecError("enough")

    monkeypatch.setattr("hil.workflow.checks.check_driver", enough)
    monkeypatch.setattr("hil.cli.run.Attended.run", enough)
    (spec, *_) = written("dwell")
    Path("mine-station.yaml").write_text(
        "hil_station: 1\nname: mine\nrobots:\n  ur5: {driver: mock, model: ur5}\n"
    )
    assert invoke(verb, str(spec)).stderr.splitlines()[0] == (
        "warning: using ur5 of the built-in mock bench, not the one in mine-station.yaml beside "
        "the spec; to use the latter: --station mine-station.yaml"
    )
    assert "warning" not in invoke(verb, str(spec), "--station", "mine-station.yaml").stderr


def test_rotor_inertias_of_a_urdf_are_named_and_left_out() -> None:
    """`hil export --to urdf` writes them as `armature`."""
    joint = '<joint name="A4" type="continuous">'
    assert joint in URDF.read_text()
    rotor = f'{joint}<dynamics damping="0.1" friction="0.2" armature="1.14"/>'
    Path("rotors.urdf").write_text(URDF.read_text().replace(joint, rotor))
    made = json.loads(invoke("new", "own-urdf", "--urdf", "rotors.urdf", "--json").stdout)
    (note,) = [note for note in made["notes"] if "armature=" in note]
    assert note.endswith(": A4 1.14")


@pytest.mark.thorough
def test_an_arm_that_the_mock_cannot_be_is_not_sent_to_commands_that_refuse_it() -> None:
    fixed = '<joint name="bolted" type="fixed">'
    assert fixed in URDF.read_text()
    turns = '<joint name="A7" type="revolute"><limit lower="-2" upper="2" effort="9" velocity="3"/>'
    Path("seven.urdf").write_text(URDF.read_text().replace(fixed, turns))
    made = json.loads(invoke("new", "own-urdf", "--urdf", "seven.urdf", "--json").stdout)
    assert (
        "but this arm has 7: `hil validate`, `plan` and `run` require a different driver"
        in made["notes"][-1]
    )
    assert made["next"] == ["hil plugins"]
    for command in made["next"]:
        assert invoke(*command.split()[1:]).exit_code == 0
    error = invoke("validate", "seven.yaml", "--station", "seven-station.yaml").exception
    assert isinstance(error, SpecError)
    assert "set another driver in the station" in error.hint


@pytest.mark.thorough
def test_a_schedule_is_lived_through_on_the_mock() -> None:
    schedule, *_ = written("re-identify")
    done = invoke("schedule", "simulate", str(schedule), "1min", "--json")
    (first,) = json.loads(done.stdout)["occasions"]
    assert first["result"]["outcome"] == "promoted"


def test_files_that_are_there_are_left_alone() -> None:
    Path("mine-campaign.yaml").write_text("precious")
    error = refused("re-identify", "mine.yaml")

    assert "mine-campaign.yaml: exists already; nothing was written" in error.message
    assert [path.name for path in Path().iterdir()] == ["mine-campaign.yaml"]


def test_schemas_that_are_there_are_left_alone() -> None:
    Path("schema").mkdir()
    Path("schema/experiment.schema.json").write_text("{}")
    assert told("dwell")["files"] == ["ur5-dwell.yaml"]
    assert Path("schema/experiment.schema.json").read_text() == "{}"


def test_robot_name_and_folder_are_the_users() -> None:
    document = told("fourier", "--robot", "lab6", "--name", "friday", "--out", "specs/new")
    spec = load_spec("specs/new/friday.yaml")
    assert (spec.name, spec.robot) == ("friday", "lab6")
    assert document["next"][0] == "hil validate specs/new/friday.yaml"


def test_a_robot_that_the_station_has_not_is_told() -> None:
    (note,) = told("fourier", "--robot", "lba6")["notes"]
    assert "has no robot 'lba6'; did you mean 'lab6'" in note


NAMES = ("007", "1e3", "true", "2026-11-22")


@pytest.mark.thorough
@pytest.mark.parametrize("kind", DRAFT_KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_names_that_yaml_takes_for_something_else_stay_names(kind: str, name: str) -> None:
    more = ("--urdf", str(URDF)) if kind == "own-urdf" else ()
    first, *others = (
        Path(file) for file in told(kind, *more, "--name", name, "--robot", name)["files"]
    )
    if kind == "station":
        assert (load_station(first).name, [*load_station(first).robots]) == (name, [name])
        return
    station = others[0] if kind == "own-urdf" else None
    if kind == "re-identify":
        first = others[0]
        name = f"{name}-probe"
    spec = load_spec(first)
    assert (spec.name, spec.robot) == (name, name.removesuffix("-probe"))
    assert station is None or [*load_station(station).robots] == [name]


def test_a_file_with_a_number_for_a_name_is_valid() -> None:
    told("dwell", "2026.yaml")
    assert load_spec("2026.yaml").name == "2026"


@pytest.mark.thorough
@pytest.mark.parametrize("urdf", ["my: arm #2.urdf", "a\nb.urdf", 'it\'s "x".urdf', "@name@.urdf"])
def test_any_urdf_can_be_named(urdf: str) -> None:
    Path(urdf).write_text(URDF.read_text())
    spec, station, arm, *_ = told(
        "own-urdf", "odd: file #1.yaml", "--name", "odd", "--robot", "odd", "--urdf", urdf
    )["files"]

    assert load_spec(spec).description == f"First Fourier trajectories of odd, from {urdf}"
    model = load_station(station).robots["odd"].model
    assert Path(model).name == Path(arm).name
    assert load_arm(model).sources["all"] == f"{urdf}, except the lines marked GUESS"


def test_a_urdf_with_an_impossible_inertia_is_refused_with_its_link() -> None:
    text = URDF.read_text("utf-8").replace('izz="0.03"/>', 'izz="0.09"/>', 1)
    Path("odd.urdf").write_text(text, "utf-8")
    error = refused("own-urdf", "--urdf", "odd.urdf")
    assert error.message.startswith("odd.urdf: is not a valid arm description: forearm")
    assert "sum of the others" in error.message


def test_nothing_is_written_that_is_not_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.spec.draft.as_scalar", lambda text: text)
    assert "must be text" in refused("dwell", "--name", "007").message
    assert not list(Path().iterdir())


def test_a_station_of_a_robot_that_is_no_arm_is_valid_and_says_which_it_took() -> None:
    (note,) = told("station", "--robot", "left")["notes"]
    assert load_station("bench.yaml" if Path("bench.yaml").exists() else "station.yaml")
    assert "'left' is not a built-in arm" in note


def test_commands_to_go_on_with_can_be_pasted() -> None:
    first, *_ = told("dwell", "my spec.yaml", "--name", "mine")["next"]
    assert first == "hil validate 'my spec.yaml'"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("dwel",), "hil new: unknown kind 'dwel'"),
        (("own-urdf",), "requires --urdf"),
        (("dwell", "--urdf", str(URDF)), "other kinds do not accept --urdf"),
        (("dwell", "--name", "a: b"), "--name 'a: b'"),
        (("dwell", "--robot", "x\ny: 1"), "--robot"),
        (("own-urdf", "--urdf", "missing.urdf"), "there is no file missing.urdf in "),
    ],
)
def test_what_cannot_be_begun_is_refused(words: tuple[str, ...], message: str) -> None:
    assert message in refused(*words).message
    assert not list(Path().iterdir())


def test_kinds_are_listed() -> None:
    assert [
        one["kind"] for one in json.loads(invoke("new", "--list", "--json").stdout)["kinds"]
    ] == [*DRAFT_KINDS, "map", *PLUGIN_KINDS]


def test_a_comment_of_a_key_that_is_none_fails() -> None:
    with pytest.raises(SpecError, match=r"excitation\.dwel_s"):
        commented("excitation:\n  kind: dwell\n  dwel_s: 1  #?\n", ExperimentSpec)


def test_comments_do_not_change_what_a_file_says() -> None:
    text = "excitation:\n  kind: dwell\n  dwell_s: 1  #? More of it.\n  # seed: 2  #?\n"
    made = commented(text, ExperimentSpec)
    assert yaml.safe_load(made) == {"excitation": {"kind": "dwell", "dwell_s": 1}}
    assert made.splitlines()[2].index("# s, ≥ 0.01") == COLUMN
    assert "More of it." in made
