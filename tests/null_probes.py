"""A mock robot that does not change, probed again and again in rooms of all temperatures."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hil import api
from hil.campaign.experiment import Experiment, load_experiment
from hil.drift.chart import REFERENCE
from hil.drift.features import Features, features_of
from hil.fitting import load_source, usable_part
from hil.identify.model_file import load_model_file

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
ROOMS_C = (14.0, 30.0)
FIRST_SEED = 501

CAMPAIGN = """
hil: 1
name: campaign
robot: ur5
excitation:
  {kind: fourier, trajectories: 8, harmonics: 5, fundamental_hz: 0.1, max_velocity_deg_s: 100,
   max_acceleration_deg_s2: 300, seed: 3}
warm_up: {duration_s: 300}
reference: {every: 0}
fit: [{estimator: rigid-hysteresis}]
validate: {hold_out: {trajectories: 2}}
"""


def on_mock(spec: Path, **options: Any) -> Experiment:
    """An experiment on the mock bench, its robot with other options."""
    experiment = load_experiment(spec, EXPERIMENTS / "stations" / "mock.yaml")
    named = experiment.spec.robot
    robot = experiment.robot.model_copy(update={"options": {**experiment.robot.options, **options}})
    station = experiment.station.model_copy(
        update={"robots": {**experiment.station.robots, named: robot}}
    )
    return replace(experiment, robot=robot, station=station, station_text=station.model_dump_json())


def null_probes(seed: int, count: int, folder: Path) -> tuple[list[Features], list[float]]:
    """Features of `REFERENCE + count` probes of one robot, and the champion's sigma.

    Args:
        seed: Of the robot, and of its rooms.
        count: Probes after the reference.
        folder: For runs; those of probes are removed once they are read.
    """
    spec = folder / f"campaign-{seed}.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    spec.write_text(CAMPAIGN, "utf-8")
    runs = folder / f"runs-{seed}"
    made = api.run(on_mock(spec, seed=seed, day=0, room_c=22.0), runs=runs)
    champion = load_model_file(made.models[0])
    rooms = np.random.default_rng(seed).uniform(*ROOMS_C, REFERENCE + count)
    found = []
    for week, room_c in enumerate(rooms, start=1):
        probe = on_mock(
            EXPERIMENTS / "ur5_probe.yaml", seed=seed, day=7 * week, room_c=float(room_c)
        )
        run = api.run(probe, runs=runs).run
        found.append(features_of(champion, usable_part(load_source(run), champion)))
        shutil.rmtree(run)
    return found, champion.sigma_.tolist()
