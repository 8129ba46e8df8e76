"""One robot as a fleet's report sees it: friction, temperature and age, from its run and model."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, HilError, read_json
from hil.estimators import load_model_file
from hil.evaluation import usable_part
from hil.importers import load_source
from hil.models.drift.history import Probe
from hil.models.fleet_robot_fit import robot_of
from hil.spec import load_station

DAYS_A_YEAR = 365.25


@dataclass(frozen=True, slots=True, eq=False)
class Surveyed:
    """One robot as it was measured.

    Attributes:
        robot: Its name.
        run: It was measured in.
        model: Folder of the model fitted to that run.
        age: Years in service on that day; NaN where the station does not say since when it is.
        joint_names: Length n.
        friction: (n,) RMS of what the model says is friction, along the run's trajectories [N·m].
        temperature: (n,) mean of the joints there [°C]; NaN where it is not measured.
        probe: The last probe of that name under its present champion, None without.
        problem: What could not be read of it, else empty.
    """

    robot: str
    run: Path
    model: Path | None
    age: float
    joint_names: tuple[str, ...]
    friction: FloatArray
    temperature: FloatArray
    probe: Probe | None = None
    problem: str = ""

    @property
    def change(self) -> FloatArray:
        """(n,) friction now as a share of the champion's, by the last probe; NaN without one."""
        if self.probe is None:
            return np.full(len(self.joint_names), np.nan)
        told = dict(zip(self.probe.features.names, self.probe.features.values, strict=True))
        return np.array([1.0 + told.get(f"{name} friction", np.nan) for name in self.joint_names])

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet report --json`."""
        return {
            "robot": self.robot,
            "run": str(self.run),
            "model": self.model and str(self.model),
            "age_years": self.age,
            "friction_nm": self.friction.tolist(),
            "temperature_c": self.temperature.tolist(),
            "change": self.change.tolist(),
            "changed": self.probe.changed if self.probe else None,
            "what": self.probe.text if self.probe else None,
            "champion": self.probe.champion if self.probe else None,
            "false_alarm": self.probe.false_alarm if self.probe else None,
            "problem": self.problem or None,
        }


def surveyed(run: Path, model: Path | None) -> Surveyed:
    """One robot, but for its probes; computed by a worker."""
    robot, age = robot_of(run), _age(run)
    try:
        if model is None:
            raise FitError(
                "it has no model: hil fleet fit",
                hint="fit it first: hil fleet fit FOLDER -e ESTIMATOR",
            )
        names, friction, temperature = _friction(run, model)
    except HilError as error:
        none = np.empty(0)
        return Surveyed(robot, run, model, age, (), none, none, problem=error.message)
    return Surveyed(robot, run, model, age, names, friction, temperature)


def _friction(run: Path, model: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    fitted = load_model_file(model)
    data = usable_part(load_source(run), fitted)
    prediction = fitted.predict(data)
    if "friction" not in prediction.components:
        raise FitError(
            f"{fitted.estimator} does not say which part of its prediction is friction",
            hint="fit with an estimator that tells friction apart",
        )
    torque = prediction.components["friction"] * fitted.torque_scale_
    friction: FloatArray = np.sqrt(np.nanmean(torque**2, axis=0))
    measured = "temperature" in data.columns
    celsius = (
        np.nanmean(data["temperature"], axis=0) if measured else np.full(len(friction), np.nan)
    )
    return fitted.joint_names_, friction, celsius


def _age(run: Path) -> float:
    """Years from the station's `in_service` to the run; NaN where either is not told."""
    try:
        start = read_json(run / "start.json")
        station = load_station(run / "station.yaml", look_up=False)
        since = station.robots[str(start["robot_name"])].in_service
        day = datetime.fromisoformat(str(start["started"])).date()
    except (HilError, KeyError, ValueError):
        return float("nan")
    return float("nan") if since is None else (day - since).days / DAYS_A_YEAR
