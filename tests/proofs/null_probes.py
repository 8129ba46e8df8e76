"""A mock robot that does not change, probed again and again in rooms of all temperatures."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from hil import api
from hil.estimators.base import load_model_file
from hil.evaluation.fitting import load_source, usable_part
from hil.maintenance.simulation import with_options
from hil.models.drift_features import Features, features_of
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from tests.support.paths import EXPERIMENTS

ROOMS_C = (14.0, 30.0)
FIRST_SEED = 501
WEAR = [1, 1.05, 1, 1, 1, 1]


def on_mock(spec: str, **options: object) -> Experiment:
    """A shipped experiment on the mock bench, its robot with other options."""
    experiment = load_experiment(EXPERIMENTS / spec, EXPERIMENTS / "stations" / "mock.yaml")
    return with_options(experiment, options)


def probes(seed: int, count: int, worn: int, folder: Path) -> tuple[list[Features], list[float]]:
    """Features of probes of one robot, and the champion's sigma.

    Args:
        seed: Of the robot, and of its rooms.
        count: Probes of the robot as it was when it was identified.
        worn: Probes after that with `WEAR`.
        folder: For runs; those of probes are removed once they are read.
    """
    runs = folder / f"runs-{seed}"
    identified = api.run(on_mock("ur5_reidentify.yaml", seed=seed, day=0, room_c=22.0), runs=runs)
    champion = load_model_file(identified.models[0])
    rooms = np.random.default_rng(seed).uniform(*ROOMS_C, count + worn)
    found = []
    for week, room_c in enumerate(rooms, start=1):
        options = {"seed": seed, "day": 7 * week, "room_c": float(room_c)}
        if week > count:
            options["wear"] = WEAR
        run = api.run(on_mock("ur5_probe.yaml", **options), runs=runs).run
        found.append(features_of(champion, usable_part(load_source(run), champion)))
        shutil.rmtree(run)
    return found, champion.sigma_.tolist()
