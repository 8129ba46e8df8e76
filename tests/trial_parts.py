"""Short trials of mock arms: a reference and a way for a hand of a second or two."""

from __future__ import annotations

import functools
import pathlib
import tempfile

import numpy as np
from collision_parts import MIDDLE, fitted
from mock_motions import fourier

from hil.payload import Payload
from hil.spec.station import StationRobot
from hil.trial.arm import RATE_HZ, Bench
from hil.trial.reference import Leading, Reference

SEED = 5
PERIOD_S = 1.5
LEAD_S = 1.0
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


@functools.cache
def model_folder():
    """The same, saved."""
    return model().save(pathlib.Path(tempfile.mkdtemp()) / "rigid-wls")


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
    monkeypatch.setattr("hil.trial.leading.ALONE_S", 1.5)
    monkeypatch.setattr("hil.trial.trial.trajectory_for", lambda bench, seed: reference())
    monkeypatch.setattr("hil.trial.trial.leading_for", lambda bench: way())
