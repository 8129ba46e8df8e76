"""The scripts of experiments/scripts on the mock: what they say, and what they end with."""

from __future__ import annotations

import importlib.util
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import typer
import yaml
from typer.testing import CliRunner, Result

import hil
from hil.core import errors
from hil.maintenance.ledger import open_ledger
from tests.support.paths import DOCS, EXPERIMENTS
from tests.support.pipeline_parts import write_schedule
from tests.support.recorded import model_of

SCRIPTS = EXPERIMENTS / "scripts"
PAGE = DOCS / "how-to" / "lab-scripts.md"
ON_A_LINE = re.compile(r"^python (experiments/scripts/\w+\.py)", re.MULTILINE)


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look for it
    spec.loader.exec_module(module)
    return module


def ended(name: str, *arguments: object) -> Result:
    app = typer.Typer()
    app.command()(script(name).main)
    return CliRunner().invoke(app, [str(one) for one in arguments])


def station(path: Path, **robots: dict[str, Any]) -> Path:
    told = {name: {"driver": "mock", "model": "ur5"} | entry for name, entry in robots.items()}
    path.write_text(json.dumps({"hil_station": 1, "name": "lab", "robots": told}), "utf-8")
    return path


@pytest.mark.thorough
def test_weekly_makes_the_first_model_champion_and_then_sees_no_change(tmp_path: Path) -> None:
    schedule = write_schedule(tmp_path)
    first = ended("weekly_reidentification", schedule, "--home", tmp_path)
    assert first.exit_code == 0, first.output
    assert first.stdout.splitlines()[0].startswith("ur5: v1 is champion: first campaign")
    assert hil.registry(tmp_path / "registry").aliases("ur5").champion == 1
    second = ended("weekly_reidentification", schedule, "--home", tmp_path)
    assert second.exit_code == 0, second.output
    assert len(second.stdout.splitlines()) == 1


def test_weekly_keeps_its_state_where_hil_does(tmp_path: Path) -> None:
    schedule = write_schedule(tmp_path / "specs").rename(tmp_path / "specs" / "of-ur5.yaml")
    with open_ledger(tmp_path / "schedules" / "weekly" / "by-hand", "weekly"):
        result = ended("weekly_reidentification", schedule, "--home", tmp_path)
    assert result.exit_code == 8, result.output
    assert "is run by" in result.stdout
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("outcome", "code", "lines"), [("promoted", 0, 7), ("kept", 10, 6), ("quiet", 0, 1)]
)
def test_weekly_tells_what_somebody_has_to_look_at(
    outcome: str, code: int, lines: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = {
        "outcome": outcome, "name": "ur5", "text": "so it is", "before": "v1", "champion": "v2",
        "errors": {"unit": "A", "before": [0.1], "after": [0.2]}, "runs": {},
    }  # fmt: skip
    monkeypatch.setattr("hil.api.reidentify", lambda *given, **options: told)
    result = ended("weekly_reidentification", "weekly.yaml")
    assert (result.exit_code, len(result.stdout.splitlines())) == (code, lines)
    assert result.stdout.splitlines()[0] == "ur5: so it is"


def test_weekly_ends_with_the_code_of_what_went_wrong(tmp_path: Path) -> None:
    result = ended("weekly_reidentification", tmp_path / "none.yaml", "--home", tmp_path)
    assert result.exit_code == 2
    assert result.stdout.startswith("none: FAILED: ")


@pytest.fixture(scope="module")
def bare_arm(fourier_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A model of the mock's arm, and the weighing program run with nothing mounted."""
    home = tmp_path_factory.mktemp("bare")
    told = yaml.safe_load((EXPERIMENTS / "ur5_weigh.yaml").read_text("utf-8"))
    told["loads"] = [{"mass_kg": 0}]
    told["excitation"]["file"] = str(EXPERIMENTS / told["excitation"]["file"])
    (home / "bare.yaml").write_text(yaml.safe_dump(told), "utf-8")
    bare = hil.run(hil.load(home / "bare.yaml", station(home / "s.yaml", ur5={})), runs=home)
    return model_of(fourier_run), bare.run


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("mounted", "code"),
    [
        ({"mass_kg": 1.5, "com_m": [0.05, 0.02, 0.06]}, 0),
        ({"mass_kg": 2.2, "com_m": [-0.03, 0.055, 0.045]}, 10),
    ],
    ids=["as declared", "another tool"],
)
def test_payload_check(
    mounted: dict[str, Any], code: int, bare_arm: tuple[Path, Path], tmp_path: Path
) -> None:
    model, bare = bare_arm
    lab = station(tmp_path / "lab.yaml", ur5={"options": {"mounted_payload": mounted}})
    spec = EXPERIMENTS / "ur5_weigh.yaml"
    result = ended(
        "payload_check", model, "--bare", bare, "--spec", spec, "--station", lab,
        "--home", tmp_path,
    )  # fmt: skip
    assert result.exit_code == code, result.output
    assert "declared 1.5 kg" in result.stdout
    if code:
        assert "DO NOT START: mass [kg] is declared as 1.5 and is " in result.stdout
    else:
        assert result.stdout.splitlines()[-1].startswith("OK: ")


def test_a_payload_that_does_not_show_contradicts_nothing() -> None:
    contradictions = script("payload_check").contradictions
    nan = float("nan")
    intervals = [(2.0, 2.4), (nan, nan)]
    assert contradictions(["mass", "com"], [2.5, 0.1], intervals, [0.2, 0.01]) == []
    (one,) = contradictions(["mass", "com"], [2.5, 0.1], intervals, [0.05, 0.01])
    assert one == "mass is declared as 2.5 and is 2.000 … 2.400"


@pytest.mark.parametrize(
    ("mass", "centre", "code", "said"),
    [
        ((math.nan, math.nan), (math.nan, math.nan), 20, "NOT CHECKED: the mass does not show"),
        ((math.nan, math.nan), (0.2, 0.3), 10, "DO NOT START: com_x [m]"),
        ((1.3, 1.6), (math.nan, math.nan), 0, "OK: "),
    ],
    ids=["nothing shows", "the centre does", "the mass does"],
)
def test_a_mass_that_does_not_show_was_not_checked(
    mass: tuple[float, float],
    centre: tuple[float, float],
    code: int,
    said: str,
    dwell_run: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = SimpleNamespace(values=[1.5], interval=[mass, *[centre] * 3], other_arm="", notes=())
    report = SimpleNamespace(error=None, run=Path("run"))
    monkeypatch.setattr("hil.api.run", lambda *given, **options: report)
    monkeypatch.setattr("hil.api.estimate_payload", lambda *given, **options: found)
    spec = EXPERIMENTS / "ur5_weigh.yaml"
    result = ended("payload_check", model_of(dwell_run), "--spec", spec)
    assert result.exit_code == code, result.output
    assert said in result.output


def test_the_code_of_what_was_not_checked_is_none_of_hil() -> None:
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    of_hil = {getattr(kind, "exit_code", 0) for kind in kinds} | {0, 1, 130}
    assert script("payload_check").NOT_CHECKED not in of_hil


@pytest.mark.thorough
def test_compare_arms_tells_a_worn_joint_and_nothing_of_the_same_arm(tmp_path: Path) -> None:
    worn = {"seed": 3, "day": 9, "wear": [1.0, 1.4, 1.0, 1.0, 1.0, 1.0]}
    lab = station(
        tmp_path / "lab.yaml",
        one={"options": {"seed": 3, "day": 7}}, again={"options": {"seed": 3, "day": 8}},
        worn={"options": worn},
    )  # fmt: skip
    told = yaml.safe_load((EXPERIMENTS / "fleet_fourier.yaml").read_text("utf-8"))
    program = tmp_path / "program.yaml"
    program.write_text(json.dumps(told), "utf-8")  # the robot is a value, not a line
    script_of = ("compare_arms", "one")
    given = ("--station", lab, "--spec", program, "--out", tmp_path / "out")
    same = ended(*script_of, "again", *given)
    assert same.exit_code == 0, same.output
    assert "0 of 58 parameters differ" in same.stdout
    other = ended(*script_of, "worn", *given)
    named = re.findall(r"^  (\w+)\.(\w+): ", other.stdout, re.MULTILINE)
    assert named[0] == ("shoulder_lift_joint", "coulomb")
    assert {joint for joint, _ in named} == {"shoulder_lift_joint"}
    text = (tmp_path / "out" / "compared.html").read_text("utf-8")
    assert "shoulder_lift_joint.coulomb" in text


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("estimator", "parameters"),
    [
        ("rigid-wls", {}), ("rigid-lmi", {}), ("rigid-irls", {}), ("rigid-diffnea", {}),
        ("rigid-linear", {}), ("rigid-linear", {"method": "ols"}),
        ("rigid-linear", {"method": "ridge"}), ("rigid-linear", {"method": "tls"}),
        ("rigid-hysteresis", {}),
    ],
)  # fmt: skip
def test_which_fits_have_standard_errors_is_known_before(
    estimator: str, parameters: dict[str, Any], bare_arm: tuple[Path, Path], tmp_path: Path
) -> None:
    run, document = bare_arm[0].parents[1], tmp_path / "parameters.json"
    fitted = hil.fit(run, estimator=estimator, parameters=parameters, out=tmp_path).fitted
    hil.export_model(fitted.folder, document, to="json")
    told = [one["std"] for one in json.loads(document.read_text("utf-8"))["parameters"]]
    assert script("compare_arms").tells_errors(estimator, parameters) == any(told)


def test_an_arm_is_not_compared_with_itself(tmp_path: Path) -> None:
    result = ended("compare_arms", "one", "one", "--out", tmp_path)
    assert result.exit_code == 2
    assert "one twice" in result.stdout


def test_arms_are_compared_by_what_both_know() -> None:
    module = script("compare_arms")
    row = {"name": "a", "unit": "N·m", "value": 1.0, "std": 0.3}
    other = row | {"name": "b", "std": None}
    one = module.Arm("<one>", [row, other], {"J1": 1.0})
    two = module.Arm("two", [row | {"value": 2.0, "std": 0.4}, other], {"J1": 2.0})
    known = module.compared(one, two)
    assert known == [("a", "N·m", 1.0, 2.0, pytest.approx(0.5), pytest.approx(2.0))]
    assert "<title>&lt;one&gt; and two</title>" in module.page(one, two, known, "")
    with pytest.raises(errors.DataError, match="no parameter of both"):
        module.compared(one, module.Arm("two", [other], {"J1": 2.0}))
    with pytest.raises(errors.DataError, match="other joints"):
        module.compared(one, module.Arm("two", [row], {"J2": 2.0}))


def test_an_arm_that_the_station_lacks_is_told(tmp_path: Path) -> None:
    lab = station(tmp_path / "lab.yaml", one={})
    program = EXPERIMENTS / "fleet_fourier.yaml"
    result = ended(
        "compare_arms", "two", "one", "--station", lab, "--spec", program, "--out", tmp_path / "out"
    )
    assert result.exit_code == 2
    assert "two" in result.stdout


@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        (["one", "two", "--spec", "no-fit.yaml"], 2, "no-fit.yaml does not fit one model"),
        (
            ["one", "two", "--spec", "unsure.yaml"],
            2,
            "unsure.yaml does not fit one model with",
        ),
        (["one", "two", "--station", "none.yaml"], 2, "none.yaml: there is no such file"),
        (["one", "three"], 2, "no robot 'three'"),
        (["one", "two", "--spec", "latin.yaml"], 2, "latin.yaml"),
        (["one", "two", "--out", "lab.yaml/out"], 7, "lab.yaml/out"),
    ],
    ids=[
        "no fit",
        "no standard errors",
        "no station",
        "no such arm",
        "not UTF-8",
        "no folder can be made",
    ],
)
def test_wrong_input_of_a_comparison_is_told_before_anything_moves(
    given: list[str], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    station(Path("lab.yaml"), one={}, two={})
    program = yaml.safe_load((EXPERIMENTS / "fleet_fourier.yaml").read_text("utf-8"))
    Path("program.yaml").write_text(json.dumps(program), "utf-8")
    unjudged = {"fit": [], "validate": {}, "accept": {"gaps_percent": {"max": 1}}}
    Path("no-fit.yaml").write_text(json.dumps(program | unjudged), "utf-8")
    unsure = {"fit": [{"estimator": "rigid-hysteresis"}]}
    Path("unsure.yaml").write_text(json.dumps(program | unsure), "utf-8")
    Path("latin.yaml").write_bytes(b"hil: 1\nname: \xe4")
    monkeypatch.setattr("hil.api.run", lambda *given, **options: pytest.fail("it moves"))
    usual = ["--station", "lab.yaml", "--spec", "program.yaml"]
    result = ended("compare_arms", *usual, *given)
    assert result.exit_code == code, result.output
    assert result.stdout.startswith("not compared: ")
    assert said in result.stdout


def test_wrong_input_of_a_payload_check_is_told_before_anything_moves(
    dwell_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.api.run", lambda *given, **options: pytest.fail("it moves"))
    spec = EXPERIMENTS / "ur5_weigh.yaml"
    no_model = ended("payload_check", tmp_path / "none", "--spec", spec)
    assert (no_model.exit_code, no_model.output[:12]) == (8, "NOT CHECKED:")
    told = yaml.safe_load(spec.read_text("utf-8"))
    told["excitation"]["file"] = str(spec.parent / told["excitation"]["file"])
    told["loads"] = [{"mass_kg": 0}, {"mass_kg": 1, "prompt": "Mount 1 kg"}]
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(told), "utf-8")
    two = ended("payload_check", tmp_path / "none", "--spec", tmp_path / "two.yaml")
    assert two.exit_code == 2
    assert "has several loads" in two.output
    model = model_of(dwell_run)
    no_bare = ended("payload_check", model, "--spec", spec, "--bare", tmp_path / "none")
    assert no_bare.exit_code == 8
    assert "does not exist" in no_bare.output


def test_a_folder_that_cannot_be_made_is_told_by_the_weekly_script(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = ended("weekly_reidentification", "weekly.yaml", "--home", tmp_path / "file")
    assert result.exit_code == 7
    assert result.stdout.startswith("weekly: FAILED: ")


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["compare_arms", "payload_check", "weekly_reidentification"])
def test_a_script_says_with_h_where_it_writes(name: str) -> None:
    said = subprocess.run(
        [sys.executable, SCRIPTS / f"{name}.py", "-h"], capture_output=True, text=True, check=True
    ).stdout
    assert "folder" in said.casefold()


def test_every_script_is_short_and_has_its_command_on_the_page() -> None:
    lab = sorted(path for path in SCRIPTS.glob("*.py") if path.stem != "fleet_station")
    assert all(len(path.read_text("utf-8").splitlines()) < 160 for path in lab)
    assert set(ON_A_LINE.findall(PAGE.read_text("utf-8"))) == {
        f"experiments/scripts/{path.name}" for path in lab
    }
