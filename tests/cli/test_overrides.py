"""`--set PATH=VALUE`: what a run was made with is in the run, and what is wrong at its option."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import hil
from hil.cli.app import app
from hil.core.errors import SpecError
from hil.planning.experiment import load as load_experiment
from hil.spec import load_spec, spec_from_text, spec_hash
from hil.spec.overrides import resolved_text

SPEC = """\
hil: 1
name: tried
robot: ur5
excitation: {kind: fourier, trajectories: 3, fundamental_hz: 0.5}    # short
warm_up: {duration_s: 0}
fit: [{estimator: rigid-wls}]
"""
FIT = ["--set", "fit=[]", "--set", "excitation.seed=9"]


@pytest.fixture
def spec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("spec.yaml").write_text(SPEC)
    return Path("spec.yaml")


def invoke(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def refused(*words: str) -> str:
    error = invoke(*words).exception
    assert isinstance(error, SpecError)
    return error.message


@pytest.mark.thorough
def test_a_run_has_the_values_it_was_made_with_and_goes_on_with_them(spec: Path) -> None:
    done = invoke("run", "spec.yaml", *FIT, "--json")
    run = Path(json.loads(done.stdout)["run"])
    start = json.loads((run / "start.json").read_text())

    assert start["overrides"] == {"fit": "[]", "excitation.seed": "9"}
    assert load_spec(run / "spec.yaml").excitation.seed == 9
    assert spec_hash(load_spec(run / "spec.yaml")) == start["spec_hash"]
    assert "#   --set excitation.seed=9" in (run / "spec.yaml").read_text()


def test_a_run_without_overrides_keeps_its_spec_as_written(spec: Path) -> None:
    assert load_experiment(spec).spec_text == SPEC
    assert spec_hash(load_experiment(spec).spec) == spec_hash(spec_from_text(SPEC))
    same = load_experiment(spec, overrides={"excitation.trajectories": "3"})
    assert spec_hash(same.spec) == spec_hash(spec_from_text(SPEC))


@pytest.mark.parametrize("value", ["'1e-3'", "'on'", "'0x14'", "12:30", "a: b", "'~'", "µ §", "''"])
def test_texts_stay_texts_in_the_spec_of_a_run(spec: Path, value: str) -> None:
    value = f"'{value}'" if value == "a: b" else value
    given = {"description": value, "record.rate_hz": "1e2"}
    wanted = load_spec(spec, given)
    again = spec_from_text(resolved_text(spec, given))

    assert again == wanted
    assert wanted.record.rate_hz == 100


@pytest.mark.thorough
def test_plan_and_optimise_take_them_too(spec: Path) -> None:
    one, two = (
        json.loads(invoke("plan", "spec.yaml", "--json", *more).stdout)["hash"]
        for more in ((), ("--set", "excitation.seed=9"))
    )
    assert one != two
    page = invoke("optimise", "spec.yaml", "--set", "excitation.trajectories=2", "--json")
    assert len(json.loads(page.stdout)["trajectories"]) == 2


def test_what_is_wrong_is_told_at_the_option(spec: Path) -> None:
    told = refused(
        "validate", "spec.yaml", "--set", "excitation.seed=8",
        "--set", "excitation.trajectorys=2", "--set", "fit.0.estimator=rigid-wsl",
    )  # fmt: skip

    assert told.splitlines() == [
        "--set 2: excitation.trajectorys: unknown key; did you mean 'trajectories'?",
        "--set 3: fit.0.estimator: there is no estimator 'rigid-wsl'; did you mean 'rigid-wls'?",
    ]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("excitation.seed", "--set 1: expected PATH=VALUE, got 'excitation.seed'"),
        ("fit.1.estimator=x", "the list has entries 0 to 0, not 1"),
        ("robot.arm=x", "the value ur5 cannot contain arm"),
        ("excitaton.seed=1", "--set 1: excitaton: unknown key; did you mean 'excitation'?"),
    ],
)
def test_a_place_that_is_none_is_refused(spec: Path, given: str, told: str) -> None:
    assert told in refused("validate", "spec.yaml", "--set", given)


def test_a_path_is_given_once(spec: Path) -> None:
    twice = ("--set", "excitation.seed=1", "--set", "excitation.seed=2")
    told = refused("plan", "spec.yaml", *twice)
    assert told == "--set 2: excitation.seed: is already set by --set 1"


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("loads.0.mass_kg=1", "loads=[{mass_kg: 2}]", "loads: would replace loads.0.mass_kg of"),
        ("loads=[{mass_kg: 2}]", "loads.0.mass_kg=1", "loads.0.mass_kg: would change loads of"),
        ("fit.0.estimator=a", "fit.00.estimator=b", "fit.00.estimator: is fit.0.estimator of"),
        ("fit.0=a", "fit.0000000000=b", "fit.0000000000: is fit.0 of"),
    ],
)
def test_no_value_undoes_another_without_a_word(
    spec: Path, first: str, second: str, told: str
) -> None:
    message = refused("plan", "spec.yaml", "--set", first, "--set", second)
    assert message == f"--set 2: {told} --set 1"


def test_an_index_is_the_same_with_zeros_before_it(spec: Path) -> None:
    told = refused("validate", "spec.yaml", "--set", "fit.0000000001.estimator=x")
    assert "the list has entries 0 to 0, not 1" in told


@pytest.mark.parametrize("given", ["fit=", "fit=null"])
def test_a_value_that_is_none_says_what_can_be_done_here(spec: Path, given: str) -> None:
    told = refused("validate", "spec.yaml", "--set", given)
    assert told.startswith("--set 1: fit: has no value: write a value after the =")
    assert "remove" not in told


def test_files_that_name_specs_take_none(spec: Path) -> None:
    Path("series.yaml").write_text("hil_series: 1\nname: s\nseries: [{spec: spec.yaml}]\n")
    for verb in ("validate", "plan", "run"):
        assert "this file is a series" in refused(verb, "series.yaml", "--set", "name=x")


def test_scripts_have_them_too(spec: Path) -> None:
    assert hil.load(spec, overrides={"excitation.seed": "9"}).spec.excitation.seed == 9


def test_what_an_option_makes_wrong_elsewhere_is_told_with_the_option(spec: Path) -> None:
    spec.write_text(SPEC + "validate: {hold_out: {trajectories: 2}}\nrobots: 1\n")
    told = refused("validate", "spec.yaml", "--set", "excitation.trajectories=2").splitlines()
    assert told == ["spec.yaml:8:1: robots: unknown key; did you mean 'robot'?"]

    spec.write_text(SPEC + "validate: {hold_out: {trajectories: 2}}\n")
    told = refused("validate", "spec.yaml", "--set", "excitation.trajectories=2").splitlines()
    assert told == [
        "spec.yaml:7:37: validate.hold_out.trajectories: holds out 2 of 2 trajectories, so that "
        "none is left to fit (with --set excitation.trajectories=2)"
    ]
