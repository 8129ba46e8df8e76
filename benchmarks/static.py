"""Friction at rest on poses never seen: ours against every other static model, and the oracle.

Each seed is a mock robot with every effect on. It runs the 650-pose program with both approaches;
whole poses, a fifth of them, are held out from every model alike, and what is predicted is the mean
current of each single-approach dwell there. The oracle knows the true parameters and the true
friction state: it is the same run of the same robot with perfect position and current sensors,
and what remains between the two is the sensors' noise.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hil.core.errors import DataError
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset, SeriesKind
from hil.data.dwells import dwells_of, series_means
from hil.data.splits import Split, split
from hil.dynamics import load_model
from hil.estimators import estimator
from hil.estimators.static_linear import StaticLinear
from hil.estimators.static_model import PaperGravity
from hil.importers.sources import load_source

SEEDS, QUICK_SEEDS = (1, 2, 3), (1,)
"""Of development; `tests/proofs/test_stick_friction.py` judges on others."""

QUICK_POSES = 70
HELD_OUT = 0.2
SPLIT_SEED = 0
EPOCHS, QUICK_EPOCHS = 150, 20
WEIGHT_DECAY = 1e-3
"""With which networks that see the approach do best: 0.0255 A on seed 1, 0.030 A without any."""

GEAR_RATIO = 101.0
GRAVITY_ONLY, SIGN, OURS = "static-wls", "static-coulomb", "static-hysteresis"

_KINDS: tuple[SeriesKind, ...] = ("dwell",)
_SPEC = Path(__file__).resolve().parent.parent / "experiments" / "ur5_dwell_650.yaml"
_NOISE = ("rest_a", "moving_a", "quantum_a", "q_rad")
"""Of a sensor in the truth; the noise of velocities stays, for the program waits by them."""


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One model, or the oracle, on held-out poses.

    Attributes:
        rmse_a: (n,) of the mean currents of dwells.
        covered: Share of errors within ±1.96 of the standard deviations told.
    """

    rmse_a: FloatArray
    covered: float = float("nan")

    @property
    def mean_a(self) -> float:
        """Mean over the joints."""
        return float(np.mean(self.rmse_a))


def run(quick: bool = False, seeds: Sequence[int] | None = None) -> dict[str, Any]:
    """Record, fit and judge, one seed after the other.

    Args:
        quick: One seed, few poses and epochs: far too few for the networks.
        seeds: Which robots instead.
    """
    chosen = tuple(seeds or (QUICK_SEEDS if quick else SEEDS))
    figures: dict[str, float] = {}
    ratios: dict[str, dict[str, float]] = {}
    for seed in chosen:
        with tempfile.TemporaryDirectory() as folder:
            noisy, perfect = record(seed, Path(folder), QUICK_POSES if quick else None)
        results = contest(noisy, perfect, QUICK_EPOCHS if quick else EPOCHS)
        told = _figures(results) | parameters(seed, noisy)
        figures |= {f"seed{seed}_{key}": value for key, value in told.items()}
        ratios[f"seed{seed}"] = _ratios(results)
    worst = {key: min(of[key] for of in ratios.values()) for key in next(iter(ratios.values()))}
    ratios["worst"] = worst
    flat = {f"{who}_{key}": value for who, of in ratios.items() for key, value in of.items()}
    return {"name": "static", "figures": figures, "ratios": flat}


def record(seed: int, folder: Path, poses: int | None = None) -> tuple[Dataset, Dataset]:
    """Return the settled dwells of one robot, and of the same robot with perfect sensors.

    Args:
        seed: Which robot.
        folder: Where to; some 150 MB.
        poses: Of the program, all 650 by default.

    Raises:
        DataError: A run did not complete, or the two did not do the same at the same time.
    """
    from hil_mock_robot.plant.truth import draw_truth

    file = draw_truth("ur5", seed).to_json(folder / "truth.json")
    truth = json.loads(file.read_text("utf-8"))
    for joint in truth["joints"]:
        joint["sensor"] |= dict.fromkeys(_NOISE, 0.0)
    file.write_text(json.dumps(truth), "utf-8")
    options: dict[str, dict[str, Any]] = {
        "noisy": {"seed": seed},
        "perfect": {"truth_file": str(file)},
    }
    at_work = {name: _start(folder / name, robot, poses) for name, robot in options.items()}
    noisy, perfect = (_dwells(folder / name, process) for name, process in at_work.items())
    if _places(noisy) != _places(perfect) or not np.array_equal(noisy["t"], perfect["t"]):
        raise DataError(f"seed {seed}: the run with perfect sensors is not the same run")
    return noisy, perfect


def contest(noisy: Dataset, perfect: Dataset, epochs: int = EPOCHS) -> dict[str, Result]:
    """Every model fitted on the same poses and judged on the others; and the oracle.

    Args:
        noisy: Dwells as measured.
        perfect: The same dwells as they were.
        epochs: Of the networks; they stop by training poses of their own.
    """
    robot, parts = load_model("ur5"), split(noisy, "pose", HELD_OUT, SPLIT_SEED)
    found = {}
    for title, (name, parameters) in models(epochs).items():
        model = estimator(name, **parameters).fit(parts.train, robot)
        predicted = model.predict(parts.test)
        error = series_means(parts.test, parts.test["effort"] - predicted.effort)
        inside = np.abs(error) <= 1.96 * series_means(parts.test, predicted.std)
        found[title] = Result(_rms(error), float(np.mean(inside)))
    return found | {"oracle": Result(_rms(_sensor_noise(parts, noisy, perfect)))}


def models(epochs: int) -> dict[str, tuple[str, dict[str, Any]]]:
    """Title → estimator and its parameters."""
    network = {"epochs": epochs, "patience": 30, "weight_decay": WEIGHT_DECAY, "jobs": 2}
    approach = {"layers": [5, 20, 20, 10, 1], "inputs": ["q2", "q3", "q4", "q5", "approach"]}
    return {
        GRAVITY_ONLY: ("static-wls", {}),
        "static-linear": ("static-linear", {"method": "ls"}),
        "static-mlp-lm": ("static-mlp-lm", network),
        "static-mlp-lm_approach": ("static-mlp-lm", network | approach),
        SIGN: ("static-coulomb", {}),
        OURS: ("static-hysteresis", {"gear_ratio": GEAR_RATIO}),
    }


def parameters(seed: int, dwells: Dataset) -> dict[str, float]:
    """Gravity in amperes per φ of eq. 15, by least squares on all poses, beside the truth.

    In amperes, since data-sheet gains scale torques. The truth is the plant's gravity over its K1;
    what K2 and friction add is the bias.
    """
    model = StaticLinear(method="ls").fit(dwells, load_model("ur5"))
    q = series_means(dwells, dwells["q"])
    currents = _true_gravity_current(seed, q)
    form = PaperGravity(model.robot_)
    owner, columns = np.array(form.joint, dtype=int), form.columns(q).reshape(*q.shape, -1)
    truth = np.zeros(len(owner))
    for joint in np.unique(owner):
        phi = columns[:, joint, owner == joint]
        truth[owner == joint] = np.linalg.lstsq(phi, currents[:, joint])[0]
    count, scale = len(truth), model.torque_scale_[owner]
    found = model.coefficients_[:count] / scale
    low, high = (model.interval()[:count] / scale[:, None]).T
    inside = (low <= truth) & (truth <= high)
    return {
        "parameters_within_95_percent": float(np.mean(inside)),
        "parameters_bias_of_largest": float(np.max(np.abs(found - truth)) / np.max(np.abs(truth))),
    }


def _true_gravity_current(seed: int, q: FloatArray) -> FloatArray:
    """(D, n) gravity of the mock's own plant over K1 [A] at positions (D, n)."""
    from hil_mock_robot.plant.simulation import Setting, Simulation
    from hil_mock_robot.plant.truth import draw_truth

    truth, still = draw_truth("ur5", seed), np.zeros(q.shape[1])
    plant = Simulation(truth, Setting(125.0), q[0].copy()).plant
    gains = np.array([joint.drive.gain_nm_a for joint in truth.joints])
    torque = np.stack([plant.inverse(one, still, still) for one in q])
    return np.asarray(torque / gains)


def _start(folder: Path, options: dict[str, Any], poses: int | None) -> subprocess.Popen[str]:
    """`hil run` in a process of its own: its memory ends with it, and two share the cores."""
    folder.mkdir()
    spec = yaml.safe_load(_SPEC.read_text("utf-8"))
    for judged in ("fit", "validate", "accept"):
        del spec[judged]
    if poses:
        spec["excitation"]["waypoints"] = poses
    robot = {"driver": "mock", "model": "ur5", "options": options, "surroundings": {"table_z_m": 0}}
    (folder / "spec.yaml").write_text(yaml.safe_dump(spec), "utf-8")
    station = {"hil_station": 1, "robots": {"ur5": robot}}
    (folder / "station.yaml").write_text(yaml.safe_dump(station), "utf-8")
    command = [sys.executable, "-m", "hil", "run", "spec.yaml", "--station", "station.yaml"]
    return subprocess.Popen(
        command, cwd=folder, env=os.environ | {"OMP_NUM_THREADS": "1"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def _dwells(folder: Path, process: subprocess.Popen[str]) -> Dataset:
    told, _ = process.communicate()
    runs = sorted((folder / "runs").glob("*/ur5/*"))
    if process.returncode or not runs:
        raise DataError(f"hil run ended with {process.returncode}: {told[-2000:]}")
    return dwells_of(load_source(runs[0], _KINDS))


def _places(dwells: Dataset) -> list[tuple[str, int, int]]:
    return [(c.id, c.pose, c.approach) for c in dwells.conditions]


def _sensor_noise(parts: Split, noisy: Dataset, perfect: Dataset) -> FloatArray:
    """(D, n) mean current of each held-out dwell less what it was without the sensors' noise."""
    held_out = {condition.id for condition in parts.test.conditions}
    keep = np.array([condition.id in held_out for condition in noisy.conditions])
    means: FloatArray = series_means(noisy, noisy["effort"] - perfect["effort"])[keep]
    return means


def _rms(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def _figures(results: dict[str, Result]) -> dict[str, float]:
    rmse = {f"{title}_rmse_a": result.mean_a for title, result in results.items()}
    return rmse | {f"{OURS}_covered": results[OURS].covered}


def _ratios(results: dict[str, Result]) -> dict[str, float]:
    """How many times ours is better, and how much of what is left to gain it gains."""
    ours, oracle = results[OURS].mean_a, results["oracle"].mean_a
    others = {t: r.mean_a for t, r in results.items() if t not in (OURS, "oracle")}
    best = min(others.values())
    return {
        "gravity_only_vs_ours": others[GRAVITY_ONLY] / ours,
        "sign_vs_ours": others[SIGN] / ours,
        "best_other_vs_ours": best / ours,
        "share_of_gap_to_oracle": (best - ours) / (best - oracle),
    }
