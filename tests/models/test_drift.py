"""Drift: charts over probes, their history, and what warmth does to friction."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core import json_value
from hil.core.errors import DataError, RegistryError
from hil.data.dataset import Dataset
from hil.models.drift import (
    PROBES_FILE,
    REFERENCE,
    assess,
    causes,
    causes_text,
    chart_of,
    friction_change,
    identity,
    probes_of,
)
from hil.models.drift_features import Features, feature_names
from hil.models.model_registry import Registry
from hil.models.registries_file import registries_of
from tests.support.drift_parts import probe
from tests.support.synthetic_motion import LOAD, moving

# Charts that call no robot changed which is not, more often than they say, and find what is


JOINTS = tuple(f"j{k + 1}" for k in range(6))
NAMES = feature_names(JOINTS)
SIGMA = np.full(6, 0.05)
PER_K = {"friction": 0.006, "gain": 0.001, "offset": 0.001}
BLOCKS = 6
NOISE = {"friction": 0.008, "gain": 0.004, "offset": 0.003}


def robot(dice: np.random.Generator):
    """A function from temperature to a probe's features, of a robot with a model's usual errors."""
    what = [name.rsplit(" ", 1)[1] for name in NAMES]
    slope = np.array([dice.normal(0, PER_K.get(w, 0.001)) for w in what])
    level = np.array([dice.normal(0, 3 * NOISE.get(w, 0.005)) for w in what])
    noise = np.array([NOISE.get(w, 0.005) for w in what])
    # The model's error along the motion, the same in every probe.
    places = 6 * noise * dice.standard_normal((BLOCKS, len(NAMES)))
    places -= places.mean(axis=0)

    def probe(celsius: float) -> Features:
        values = level + slope * (celsius - 25.0) + noise * dice.standard_normal(len(NAMES))
        warm = np.full(len(NAMES), celsius)
        dice_of_blocks = dice.standard_normal((BLOCKS, len(NAMES)))
        own = np.sqrt(BLOCKS) * noise * (dice_of_blocks - dice_of_blocks.mean(axis=0))
        blocks = values + places + own
        std = np.std(blocks, axis=0, ddof=1) / np.sqrt(BLOCKS)
        return Features(NAMES, values, std, warm, np.zeros(6), 1000, np.eye(len(NAMES)), blocks)

    return probe


def changed(probe: Features, name: str, by: float) -> Features:
    values = probe.values + by * (np.array(NAMES) == name)
    return replace(probe, values=values)


@pytest.mark.thorough
@pytest.mark.parametrize("swing", [0.0, 8.0])
def test_a_robot_that_does_not_change_is_called_so_as_rarely_as_stated(swing: float) -> None:
    dice, alarms, count = np.random.default_rng(3), 0, 0
    for _ in range(60):
        probe = robot(dice)
        probes = [probe(25.0 + swing * dice.uniform(-1, 1)) for _ in range(20)]
        for k in range(1, len(probes) + 1):
            alarms += bool(chart_of(probes[:k], SIGMA, 0.05).alarm.any())
            count += 1
    assert count == 1200
    assert alarms >= 6  # charts that call nothing are no charts
    assert alarms <= 60 + 3 * np.sqrt(60)  # 5 % of them, and what chance may add


@pytest.mark.parametrize("swing", [0.0, 8.0])
def test_more_friction_is_found_by_the_first_probe_and_named(swing: float) -> None:
    found = 0
    for seed in range(20):
        dice = np.random.default_rng(seed)
        probe = robot(dice)
        probes = [probe(25.0 + swing * dice.uniform(-1, 1)) for _ in range(REFERENCE + 1)]
        worn = changed(probe(25.0 + 0.5 * swing), "j2 friction", 0.15)
        chart = chart_of([*probes, worn], SIGMA)
        named = causes(worn, chart, 0.01, "A")
        found += bool(named) and named[0].name == "j2 friction"
        assert not named or abs(named[0].change - 0.15) < 5 * named[0].std
    assert found >= 18


def test_what_creeps_is_found_by_the_weighted_mean() -> None:
    """A change too small for any single probe."""
    single = crept = 0
    for seed in range(20):
        dice = np.random.default_rng(seed)
        probe = robot(dice)
        probes = [probe(25.0) for _ in range(REFERENCE)]
        for _ in range(12):
            probes.append(changed(probe(25.0), "j3 friction", 0.03))
        chart = chart_of(probes, SIGMA)
        k = NAMES.index("j3 friction")
        single += bool(np.abs(chart.deviation[k]) > chart.limit[k])
        crept += bool(chart.alarm[k])
    assert crept > single
    assert crept >= 10


def test_before_anything_is_known_nothing_is_a_change() -> None:
    probe = robot(np.random.default_rng(0))
    chart = chart_of([probe(40.0)], SIGMA)
    assert not chart.alarm.any()
    assert chart.reference == 0
    assert causes_text(causes(probe(40.0), chart, 0.01, "A")) == "nothing has changed"


def test_one_cause_that_moves_others_is_named_alone() -> None:
    """Mass at the flange looks like gain in three joints."""
    dice = np.random.default_rng(5)
    probe = robot(dice)
    response = np.eye(len(NAMES))
    mass = NAMES.index("load mass")
    for joint, share in (("j2", 0.2), ("j3", 0.3), ("j4", 0.25)):
        response[NAMES.index(f"{joint} gain"), mass] = share
    probes = [probe(25.0) for _ in range(REFERENCE)]
    loaded = replace(probe(25.0), response=response)
    loaded = replace(loaded, values=loaded.values + response[:, mass] * 0.4)
    chart = chart_of([*probes, loaded], SIGMA)
    assert chart.alarm.sum() >= 3
    (cause,) = causes(loaded, chart, 0.01, "A")
    assert cause.name == "load"
    assert cause.change == pytest.approx(0.4, abs=0.05)
    assert cause.text.startswith("load at the flange: +0.4")


def test_what_is_called_changed_always_has_a_cause() -> None:
    """Even where the model fits so badly along the motion that the cause can hardly be told."""
    probe = robot(np.random.default_rng(4))
    probes = [probe(25.0) for _ in range(REFERENCE)]
    moved = changed(probe(25.0), "j5 offset", 0.06)
    moved = replace(moved, std=100.0 * moved.std)
    chart = chart_of([*probes, moved], SIGMA)
    assert chart.alarm.any()
    assert causes(moved, chart, 0.01, "A")


def test_what_repeats_along_the_motion_is_no_noise() -> None:
    """Within each probe the model errs by six times the noise, in the same places every time."""
    probe = robot(np.random.default_rng(2))
    probes = [probe(25.0) for _ in range(REFERENCE + 1)]
    chart = chart_of(probes, SIGMA)
    within = np.median([one.std for one in probes], axis=0)
    assert np.median(chart.std / within) < 0.6
    alone = chart_of(probes[:2], SIGMA)
    assert np.median(alone.std / within) > 0.9


def test_features_come_back_from_json_as_they_were() -> None:
    one = robot(np.random.default_rng(1))(20.0)
    again = Features.from_dict(one.to_dict())
    assert np.array_equal(again.values, one.values)
    assert np.array_equal(again.blocks, one.blocks)
    assert again.names == one.names
    with pytest.raises(ValueError, match="blocks"):
        Features.from_dict(one.to_dict() | {"blocks": [[1.0]]})
    with pytest.raises(ValueError, match="response"):
        Features.from_dict(one.to_dict() | {"response": [[1.0]]})


def test_probes_of_different_robots_are_not_charted_together() -> None:
    probe = robot(np.random.default_rng(1))(20.0)
    other = replace(probe, names=("x friction", *NAMES[1:]))
    with pytest.raises(DataError, match="different robots"):
        chart_of([probe, other], SIGMA)


def test_copies_of_a_probe_are_one_probe() -> None:
    """A mock on the same day gives the same bits."""
    dice = np.random.default_rng(6)
    probe = robot(dice)
    one = probe(25.0)
    assert chart_of([one] * 6, SIGMA).reference == 0
    others = [probe(25.0) for _ in range(REFERENCE)]
    with_copies = chart_of([one, one, *others, others[-1], probe(25.0)], SIGMA)
    assert with_copies.reference == REFERENCE
    assert not with_copies.alarm.any()


def test_probes_without_any_noise_can_be_charted() -> None:
    probe = robot(np.random.default_rng(7))(25.0)
    silent = [
        replace(probe, values=probe.values * k, std=0 * probe.std, blocks=0 * probe.blocks)
        for k in (1.0, 1.0 + 1e-12, 1.0 + 2e-12)
    ]
    assert np.all(np.isfinite(chart_of(silent, SIGMA).p))


# Probes of one arm after the other: judged once, kept, and named when something has changed


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
    with pytest.raises(DataError, match="training data of the model"):
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


# What warmth does to friction, by a model's own law


FRICTION_PER_K = np.array([-0.01, 0.0, 0.002, -0.004, -0.01, -0.02])


class Law:
    """A model whose friction goes with temperature by known shares, and by nothing else."""

    estimator = "law"

    def predict(self, data: Dataset) -> SimpleNamespace:
        friction = np.sign(data["qd"]) * (1.0 + FRICTION_PER_K * (data["temperature"] - 20.0))
        valid = np.ones(friction.shape, dtype=bool)
        return SimpleNamespace(valid=valid, components={"friction": friction})


class Silent(Law):
    def predict(self, data: Dataset) -> SimpleNamespace:
        return SimpleNamespace(valid=None, components={})


def test_friction_changes_by_what_the_law_says_between_two_temperatures() -> None:
    found = friction_change(Law(), moving(1), np.full(6, 20.0), 20.0 + np.arange(6.0))
    assert found == pytest.approx(FRICTION_PER_K * np.arange(6.0))


def test_a_model_that_does_not_tell_friction_apart_is_refused() -> None:
    with pytest.raises(DataError, match="does not predict friction separately"):
        friction_change(Silent(), moving(1), np.zeros(6), np.ones(6))
