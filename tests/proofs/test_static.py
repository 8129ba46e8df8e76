"""Static identification against the mock's truth: intervals that hold, gains that are right.

Figures are printed. On `ideal` arms the intervals are judged; on `full` arms, whose friction is
more than any linear model says, bias and coverage are told and not promised.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import hil
from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.data.dataset import Dataset
from hil.dynamics import base_parameters, load_model
from hil.estimators.drive_gains import calibrate_gains
from hil.estimators.static_linear import StaticLinear
from hil.importers.sources import load_source
from hil_mock_robot.plant.model import build_plant
from hil_mock_robot.plant.truth import draw_truth
from tests.support.paths import EXPERIMENTS

pytestmark = [pytest.mark.proof, pytest.mark.timeout(900)]

SEEDS = (11, 12, 13, 14)
POSES, PROGRAMS, SHUFFLES = 240, 10, 3
"""Each arm stands at 240 poses, which make ten independent programs of 24; shuffled three times."""

METHODS: tuple[dict[str, Any], ...] = (
    {},
    {"method": "wls"},
    {"method": "wls", "weights": "repeats"},
    {"method": "wls", "weights": "pose"},
    {"rows": "samples"},
)


def show(*figures: object) -> None:
    """For people: `make proof` runs with -s."""
    print(*figures)  # noqa: T201


def recorded(folder: Path, spec: str, seed: int, profile: str) -> Dataset:
    """Run a spec on the mock and read its dwells."""
    options = {"profile": profile, "seed": seed}
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": options}}
    (folder / "spec.yaml").write_text(spec, "utf-8")
    station = {"hil_station": 1, "name": "bench", "robots": robots}
    (folder / "station.yaml").write_text(yaml.safe_dump(station), "utf-8")
    report = hil.run(hil.load(folder / "spec.yaml", folder / "station.yaml"), runs=folder / "runs")
    return load_source(report.run, kinds=("dwell",))


def dwell_program(seed: int, dwell_s: float) -> str:
    # In 95 ms an ideal arm still creeps against its smooth friction; after a second it stands.
    return f"""\
hil: 1
name: coverage
robot: ur5
excitation: {{kind: dwell, waypoints: {POSES}, dwell_s: {dwell_s}, samples_per_dwell: 10,
  max_velocity_deg_s: 60, max_acceleration_deg_s2: 80, approach: both, seed: {seed}}}
fit: []
"""


def true_parameters(seed: int, profile: str) -> tuple[np.ndarray, np.ndarray]:
    """Gravity base parameters by MuJoCo and offsets of the shared form, and the true gains."""
    truth = draw_truth("ur5", seed, profile)  # type: ignore[arg-type]
    plant = build_plant(
        load_arm("ur5").dh, truth.links, [0.1] * 6, Payload(), (0.0, 0.0, -9.81), 1e-3
    )
    robot, still = load_model("ur5"), np.zeros(6)
    q = np.random.default_rng(0).uniform(-3, 3, (200, 6))
    torque = np.array([plant.inverse(pose, still, still) for pose in q])
    columns = base_parameters(robot, gravity_only=True).reduce(robot.gravity_regressor(q))
    gravity, rest = np.linalg.lstsq(columns, torque.ravel())[:2]
    assert rest < 1e-18
    offset = [j.friction.offset_nm - j.drive.constant_nm for j in truth.joints]
    return np.append(gravity, offset), np.array([j.drive.gain_nm_a for j in truth.joints])


def programs(data: Dataset, seed: int) -> list[Dataset]:
    """Disjoint parts of the poses, as independent as programs of their own."""
    random, found = np.random.default_rng(seed), []
    for _ in range(SHUFFLES):
        for part in np.array_split(random.permutation(POSES), PROGRAMS):
            chosen = set(part.tolist())
            found.append(data.select(lambda c, chosen=chosen: c.pose in chosen))
    return found


def coverage(parts: list[Dataset], truth: np.ndarray, params: dict[str, Any]) -> np.ndarray:
    """(P, p) which 95 % intervals hold the truth."""
    robot, hits = load_model("ur5"), []
    for part in parts:
        low, high = StaticLinear(form="shared", **params).fit(part, robot).interval(0.95).T
        hits.append((low <= truth) & (truth <= high))
    return np.array(hits)


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[list[Dataset], np.ndarray]]:
    found = []
    for seed in SEEDS:
        truth, gains = true_parameters(seed, "ideal")
        folder = tmp_path_factory.mktemp(f"ideal{seed}")
        data = recorded(folder, dwell_program(seed, 1.0), seed, "ideal")
        found.append((programs(replace(data, drive_gains=gains), seed), truth))
    return found


@pytest.mark.parametrize("params", METHODS, ids=lambda p: "-".join(p.values()) or "ls")
def test_95_percent_intervals_hold_the_truth_of_ideal_arms_in_92_to_98(ideal: Any, params) -> None:
    hits = np.concatenate([coverage(parts, truth, params) for parts, truth in ideal])
    show(
        f"{params or 'ls'}: {np.mean(hits):.3f} of {hits.size}; worst {hits.mean(axis=0).min():.3f}"
    )
    assert 0.92 <= np.mean(hits) <= 0.98


def test_bias_and_coverage_on_a_full_arm_are_told(tmp_path: Path) -> None:
    truth, gains = true_parameters(11, "full")
    data = recorded(tmp_path, dwell_program(11, 0.095), 11, "full")
    declared = data.drive_gains
    for name, used in (("true", gains), ("declared", declared)):
        told = replace(data, drive_gains=used)
        whole = StaticLinear(form="shared").fit(told, load_model("ur5"))
        hits = coverage(programs(told, 11), truth, {})
        show(f"full arm, {name} gains: coverage {np.mean(hits):.2f} with 24 poses; with {POSES}:")
        for parameter, value, error, true in zip(
            whole.parameter_names_, whole.coefficients_, whole.std_error_, truth, strict=True
        ):
            show(f"  {parameter:50} {value:8.3f} ± {error:.3f}, true {true:8.3f}")
    assert len(hits) == PROGRAMS * SHUFFLES


@pytest.mark.parametrize("seed", SEEDS)
def test_gains_of_full_arms_are_found_by_the_shipped_program(seed: int, tmp_path: Path) -> None:
    spec = (EXPERIMENTS / "ur5_gains.yaml").read_text("utf-8")
    found = calibrate_gains(recorded(tmp_path, spec, seed, "full"), load_model("ur5"))
    drives = [joint.drive for joint in draw_truth("ur5", seed).joints]
    k1 = np.array([drive.gain_nm_a for drive in drives])
    k2 = np.array([drive.square_nm_a2 for drive in drives])
    show(f"seed {seed}: gain {found.gain.round(3)} ± {found.gain_error.round(3)}, K1 {k1.round(3)}")
    assert found.determined.tolist() == [False, True, True, True, True, True]
    # A drive that bends by K2 has, at currents up to i, gains from K1 down to K1 + 2·K2·i.
    bend = np.array([0.0, 9.0, 5.0, 1.0, 0.6, 0.4]) * 2 * np.abs(k2)
    low, high = k1 - bend - 3 * found.gain_error, k1 + 3 * found.gain_error
    assert np.all((low <= found.gain) & (found.gain <= high) | ~found.determined)
    shown = np.isfinite(found.k2)
    show(f"  K1 {found.k1.round(3)} ± {found.k1_error.round(3)}, K2 {found.k2.round(3)}")
    assert np.all(np.abs(found.k1 - k1)[shown] < 4 * found.k1_error[shown])
    assert np.all(np.abs(found.k2 - k2)[shown] < 4 * found.k2_error[shown])
