"""Probes of one arm after the other: judged once, kept, and named when something has changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core import json_value
from hil.core.errors import DataError, RegistryError
from hil.models.drift import PROBES_FILE, assess, identity, probes_of
from hil.models.model_registry import Registry
from hil.models.registries_file import registries_of
from tests.support.drift_parts import probe
from tests.support.synthetic_motion import LOAD

MOTION = 30


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A champion's folder and what it was fitted to."""
    folder = tmp_path_factory.mktemp("campaign")
    campaign = probe(folder, 1, noise=1)
    return hil.fit([campaign], estimator="rigid-wls", out=folder).fitted.folder, campaign


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("quiet")
    return [probe(folder, MOTION, noise=100 + k) for k in range(5)]


@pytest.fixture
def registry(model: tuple[Path, Path], tmp_path: Path) -> Registry:
    made = Registry(tmp_path / "registry")
    made.register("ur5", model[0], {})
    made.promote("ur5", 1, reason="", evidence={}, instead_of=0)
    return made


@pytest.mark.thorough
def test_nothing_changes_until_something_does(registry, quiet, tmp_path: Path) -> None:
    told = [assess(registry, "ur5", source) for source in quiet]
    assert not any(one.changed for one in told)
    assert [one.reference for one in told] == [0, 1, 2, 3, 4]
    worn = assess(registry, "ur5", probe(tmp_path, MOTION, noise=7, more_friction=0.15))
    assert worn.changed
    assert worn.causes[0].name == "shoulder_lift_joint friction"
    assert worn.text.startswith("friction up on shoulder_lift_joint: +")


@pytest.mark.thorough
def test_a_load_nobody_told_of_is_named(registry, quiet, tmp_path: Path) -> None:
    for source in quiet:
        assess(registry, "ur5", source)
    loaded = assess(registry, "ur5", probe(tmp_path, MOTION, noise=8, load=LOAD))
    names = [cause.name for cause in loaded.causes]
    assert names[0] == "load", loaded.text
    assert loaded.causes[0].change == pytest.approx(LOAD.mass, abs=0.3)


def test_a_probe_is_judged_once_and_kept(registry, quiet) -> None:
    first = assess(registry, "ur5", quiet[0])
    again = assess(registry, "ur5", quiet[0])
    assert json_value(again.to_dict()) == json_value(first.to_dict())
    (kept,) = probes_of(registry, "ur5")
    assert json_value(kept.to_dict()) == json_value(first.to_dict())


def test_runs_of_probes_lead_to_the_registry(registry, quiet, tmp_path: Path) -> None:
    run = tmp_path / "runs" / "2026-11-20" / "ur5" / "0001-probe"
    run.mkdir(parents=True)
    (run / "start.json").write_text("{}")
    assess(registry, "ur5", shutil.copy(quiet[0], run / "00.mcap"))
    assert registries_of(tmp_path / "runs") == [registry.root]


@pytest.mark.thorough
def test_a_new_champion_begins_anew(registry, quiet, model, tmp_path: Path) -> None:
    for source in quiet[:3]:
        assess(registry, "ur5", source)
    other = hil.fit([model[1]], estimator="rigid-irls", out=tmp_path).fitted.folder
    number = registry.register("ur5", other, {}).number
    registry.promote("ur5", number, reason="", evidence={}, instead_of=1)
    assert assess(registry, "ur5", quiet[3]).reference == 0
    assert assess(registry, "ur5", quiet[0]).champion == number
    assert len(probes_of(registry, "ur5")) == 5


def test_what_the_champion_learned_from_is_no_probe(registry, model) -> None:
    with pytest.raises(DataError, match="fitted to"):
        assess(registry, "ur5", model[1])


def test_a_torn_line_is_none_and_a_damaged_one_is_told(registry, quiet) -> None:
    assess(registry, "ur5", quiet[0])
    path = registry.root / "ur5" / PROBES_FILE
    whole = path.read_bytes()
    path.write_bytes(whole + whole[: len(whole) // 2])
    assert len(probes_of(registry, "ur5")) == 1
    assess(registry, "ur5", quiet[1])
    assert len(probes_of(registry, "ur5")) == 2
    path.write_bytes(b"{}\n" + whole)
    with pytest.raises(RegistryError, match=r"probes.jsonl:1: damaged"):
        probes_of(registry, "ur5")


def test_without_a_champion_there_is_nothing_to_judge_by(model, quiet, tmp_path: Path) -> None:
    empty = Registry(tmp_path / "registry")
    empty.register("ur5", model[0], {})
    with pytest.raises(RegistryError, match="no champion"):
        assess(empty, "ur5", quiet[0])


@pytest.mark.thorough
def test_at_the_command_line(registry, quiet) -> None:
    where = ["--registry", str(registry.root)]
    assert "no probes of ur5 yet" in CliRunner().invoke(app, ["drift", "ur5", *where]).stdout
    done = CliRunner().invoke(app, ["drift", "ur5", *map(str, quiet[:3]), *where])
    assert done.exit_code == 0, done.output
    assert done.stdout.count("no ") >= 3
    told = json.loads(CliRunner().invoke(app, ["drift", "ur5", *where, "--json"]).stdout)
    assert [one["reference"] for one in told["probes"]] == [0, 1, 2]


def test_a_program_is_the_same_wherever_the_arm_stood_before_it(tmp_path: Path) -> None:
    """Its plan is another one: the way from there to the first pose belongs to it."""
    for number, plan in enumerate(("from here", "from there")):
        run = tmp_path / str(number)
        run.mkdir()
        start = {"uid": str(number), "started": "", "plan_hash": plan, "spec_hash": "probe"}
        (run / "start.json").write_text(json.dumps(start), "utf-8")
        assert identity(run)[2] == "probe"
