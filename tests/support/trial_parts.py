"""Short trials of mock arms: a reference and a way for a hand of a second or two."""

from __future__ import annotations

import copy
import functools
import pathlib
import tempfile
from dataclasses import replace

import numpy as np
import pytest

from hil import api
from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.control.controllers import Reference
from hil.control.try_out import Bench, Leading
from hil.control.try_out_settings import RATE_HZ
from hil.data import Conditions, Dataset
from hil.dynamics import load_model
from hil.estimators import estimator
from hil.spec.station import StationRobot
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import draw_truth
from tests.support.collision_parts import MIDDLE, fitted
from tests.support.mock_motions import fourier

SEED = 5
PERIOD_S = 1.5
LEAD_S = 1.0
ELSEWHERE = "elsewhere-7"
STATION = """hil_station: 1
robots:
  arm: {driver: mock, model: ur5, options: {seed: 5}}
  timed: {driver: mock, model: ur5, options: {seed: 5, clock: wall}}
  real: {driver: ur, model: ur5, options: {host: 192.0.2.1}}
"""


def bench(seed=SEED, **options):
    """A mock UR5."""
    robot = StationRobot(driver="mock", model="ur5", options={"seed": seed, **options})
    return Bench("arm", robot, Payload())


@functools.cache
def model():
    """Fitted to five motions of the mock's arm."""
    return fitted(SEED, "rigid-wls")


def of_arm(arm, seed):
    """A model with friction in memory, fitted to five motions of ten seconds of any mock."""
    rate, truth, robot = load_arm(arm).rate_hz, draw_truth(arm, seed), load_model(arm)
    series = []
    for k in range(100, 105):
        start = MIDDLE + np.random.default_rng([7, k]).uniform(-0.7, 0.7, 6)
        setpoints = fourier(start, rate, k, 10.0, peak_rad_s=1.2)
        simulation = Simulation(truth, Setting(rate), setpoints[0, 0].copy())
        simulation.settle()
        measured = simulation.advance(setpoints).values[:, :4].swapaxes(0, 1)
        sensors = Sensors(truth)
        sensors._rng = np.random.default_rng([seed, k])
        q, qd, current, _ = sensors.measure(*measured)
        columns = {"t": np.arange(len(q)) / rate, "q": q, "qd": qd, "effort": current}
        gains = np.array([joint.drive.gain_nm_a for joint in truth.joints])
        condition = Conditions(f"motion {k}", "trajectory", "mock", k)
        series.append(
            Dataset(
                arm,
                robot.joint_names,
                "current",
                columns,
                np.array([0, len(q)]),
                (condition,),
                gains,
                "the truth",
            )
        )
    return estimator("rigid-hysteresis").fit(Dataset.concatenate(series), robot)


@functools.cache
def model_folder():
    """The same, saved, of an arm that is in no station here."""
    made = copy.copy(model())
    made.training_ = replace(made.training_, serial=ELSEWHERE)
    return made.save(pathlib.Path(tempfile.mkdtemp()) / "rigid-wls")


@functools.cache
def short_trial():
    """A whole trial of it, and the folder that it was written to."""
    folder = pathlib.Path(tempfile.mkdtemp())
    (folder / "station.yaml").write_text(STATION, "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        station = folder / "station.yaml"
        return api.simulate(model_folder(), folder / "out", station=station, robot="arm"), folder


def reference():
    """A short series after half a second of rest."""
    q, qd, qdd = fourier(MIDDLE, RATE_HZ, 3, PERIOD_S, peak_rad_s=1.0).swapaxes(0, 1)
    still = np.zeros((500, 6))
    return Reference(
        np.arange(-499, len(q) + 1) / RATE_HZ,
        np.concatenate((still + q[0], q)),
        np.concatenate((still, qd)),
        np.concatenate((still, qdd)),
    )


def way():
    """Ten degrees for every joint."""
    return Leading(MIDDLE, np.full(6, np.radians(10.0)), LEAD_S)


def shorten(monkeypatch):
    """Have a whole trial take a few seconds of simulated time."""
    monkeypatch.setattr("hil.control.try_out.ALONE_S", 1.5)
    monkeypatch.setattr("hil.control.try_out.trajectory_for", lambda bench, seed: reference())
    monkeypatch.setattr("hil.control.try_out.leading_for", lambda bench: way())
