"""State of every robot of a fleet: drift, friction, temperature and age, and outliers.

`survey_fleet` reads the last probe, the friction of the last model and the temperature of every
robot, and compares the robots joint by joint (`hil.models.fleet_outliers`). The friction of robots
is compared only between models of the same estimator. The module `fleet_probes` creates the probes
that a survey reads.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray, HilError, read_json, spread_over_processes
from hil.estimators import load_model_file, models_below
from hil.evaluation import usable_part
from hil.importers import load_source
from hil.models.drift import Probe, probes_of
from hil.models.fleet_fits import DIED, robot_of
from hil.models.fleet_outliers import FAMILY_WISE, Comparison, compare_robots
from hil.models.model_registry import Registry
from hil.recording import FleetGroup
from hil.spec import load_station


@dataclass(frozen=True, slots=True, eq=False)
class SurveyedRobot:
    """State of one robot of a fleet.

    Attributes:
        robot: Name of the robot.
        run: Run of the robot that belongs to this fleet.
        model: Folder of the model fitted to `run`; None if there is no model.
        age: Years in service on the day of the run; NaN if the station has no `in_service`.
        joint_names: Names of the n joints.
        friction: (n,) RMS of the friction component over the series to which the estimator is
            fitted [N·m].
        temperature: (n,) mean joint temperature over the series to which the estimator is fitted
            [°C]; NaN if not measured.
        probe: Last probe of the robot under the current champion; None if there is no such probe.
        problem: Reason why the robot has no friction value or is not compared; empty if neither
            applies.
        estimator: Name of the model's estimator; empty if there is no model.
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
    estimator: str = ""

    @property
    def change(self) -> FloatArray:
        """Friction (n,) at the last probe as a share of the champion's; NaN without a probe."""
        if self.probe is None:
            return np.full(len(self.joint_names), np.nan)
        values = dict(zip(self.probe.features.names, self.probe.features.values, strict=True))
        return np.array([1.0 + values.get(f"{name} friction", np.nan) for name in self.joint_names])

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of this robot in `hil fleet report --json`."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Survey of a fleet of equal arms, with a comparison of its robots.

    Attributes:
        name: Name of the fleet.
        folder: Folder of the fleet.
        robots: Measured robots.
        missing: Names of the robots of the fleet that were not measured.
        friction: Comparison of the robots' friction; None if there are too few robots.
        change: Comparison of the robots' friction at the last probe, as a share of the friction of
            their champions; None if there are too few probes.
    """

    name: str
    folder: Path
    robots: tuple[SurveyedRobot, ...]
    missing: tuple[str, ...]
    friction: Comparison | None
    change: Comparison | None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of the arms; empty if no robot has a model."""
        return next((robot.joint_names for robot in self.robots if robot.joint_names), ())

    @property
    def drifted(self) -> tuple[SurveyedRobot, ...]:
        """Names of robots with a detected change at the last probe under the current champion."""
        return tuple(robot for robot in self.robots if robot.probe and robot.probe.changed)

    @property
    def false_alarms(self) -> float:
        """Maximum expected number of robots in `drifted` if no robot has changed.

        The maximum expected number is the sum of the false-alarm rates of the last probes.
        """
        return sum(robot.probe.false_alarm for robot in self.robots if robot.probe is not None)

    def outlying(self, which: Comparison | None) -> list[tuple[int, int]]:
        """Return the outliers in a quantity as pairs (robot, joint), the largest |z| first."""
        if which is None:
            return []
        order = np.argsort(-np.abs(np.nan_to_num(which.z)), axis=None)
        places = np.column_stack(np.unravel_index(order, which.z.shape))
        return [(int(i), int(j)) for i, j in places if which.outlying[i, j]]

    def to_dict(self) -> dict[str, Any]:
        """Return the documented output of `hil fleet report --json`."""
        return {
            "fleet": str(self.folder),
            "name": self.name,
            "family_wise": FAMILY_WISE,
            "joint_names": list(self.joint_names),
            "robots": [robot.to_dict() for robot in self.robots],
            "missing": list(self.missing),
            "drifted": [robot.robot for robot in self.drifted],
            "false_alarms": self.false_alarms,
            "friction": self._compared(self.friction),
            "change": self._compared(self.change),
        }

    def _compared(self, which: Comparison | None) -> dict[str, Any] | None:
        if which is None:
            return None
        names = self.joint_names
        return {
            "limit": which.limit,
            "slopes": {
                name: {"share": which.slopes[k].tolist(), "std": which.errors[k].tolist()}
                for k, name in enumerate(which.names)
            },
            "outliers": [
                {"robot": self.robots[i].robot, "joint": names[j], "z": float(which.z[i, j])}
                for i, j in self.outlying(which)
            ],
        }


def survey_fleet(path: Path, registry: Registry, *, workers: int) -> Survey:
    """Return the state of every measured robot of a fleet.

    Args:
        path: Folder of the fleet.
        registry: Registry that contains the robots' probes; may be empty.
        workers: Number of processes that read the runs.

    Raises:
        DataError: The folder is not a fleet, no robot was measured, or the robots are arms of
            different types.
    """
    fleet = FleetGroup.open(path)
    runs = fleet.completed()
    if not runs:
        raise DataError(
            f"no robot of {fleet.path} has been measured", hint=f"hil fleet resume {fleet.path}"
        )
    models = [_model_of(fleet, run) for run in runs]
    robots: list[SurveyedRobot] = spread_over_processes(
        [partial(survey_robot, run, model) for run, model in zip(runs, models, strict=True)],
        workers,
        lambda done: None,
        lambda i: _without_friction(runs[i], models[i], DIED),
    )
    registered = set(registry.names())
    robots = [
        _with_last_probe(robot, registry) if robot.robot in registered else robot
        for robot in _of_one_estimator(robots)
    ]
    if len({robot.joint_names for robot in robots if robot.joint_names}) > 1:
        raise DataError(
            f"the robots of {fleet.path} are different arms",
            hint="run a fleet for each type of arm: their friction cannot be compared",
        )
    n = max(len(robot.joint_names) for robot in robots)
    covariates = {
        "age": np.array([robot.age for robot in robots]),
        "temperature": np.array([_or_nan(robot.temperature, n) for robot in robots]),
    }
    members = fleet.members()
    return Survey(
        str(fleet.head["name"]), fleet.path, tuple(robots),
        tuple(each.robot for each in members if each.report.get("outcome") != "completed"),
        compare_robots(np.array([_or_nan(robot.friction, n) for robot in robots]), covariates),
        compare_robots(np.array([_or_nan(robot.change, n) for robot in robots]), covariates),
    )  # fmt: skip


def _model_of(fleet: FleetGroup, run: Path) -> Path | None:
    """Return the newest model by `hil fleet fit` of this fleet, or else the run's first model."""
    files = (fleet.models / robot_of(run)).glob("*/model.json")
    newest = max(files, key=lambda file: file.stat().st_mtime, default=None)
    return newest.parent if newest else next(iter(models_below(run)), None)


def _of_one_estimator(robots: list[SurveyedRobot]) -> list[SurveyedRobot]:
    """Remove the friction of robots whose model has a different estimator than most models.

    Different estimators attribute different parts of the effort to friction.
    """
    named = Counter(robot.estimator for robot in robots if robot.estimator)
    if len(named) < 2:
        return robots
    ((common, _),) = named.most_common(1)
    return [
        replace(
            robot,
            friction=np.full_like(robot.friction, np.nan),
            problem=f"its friction is not compared: its model is from {robot.estimator}, the "
            f"others are from {common} (hil fleet fit FOLDER -e ESTIMATOR)",
        )
        if robot.estimator not in ("", common)
        else robot
        for robot in robots
    ]


def _with_last_probe(robot: SurveyedRobot, registry: Registry) -> SurveyedRobot:
    """Return a robot completed by its last probe under the current champion."""
    try:
        champion = registry.aliases(robot.robot).champion
        probes = [each for each in probes_of(registry, robot.robot) if each.champion == champion]
    except HilError as error:  # a damaged history must not affect other robots
        return replace(robot, problem="; ".join(filter(None, (robot.problem, error.message))))
    return replace(robot, probe=probes[-1] if probes else None)


def _or_nan(values: FloatArray, n: int) -> FloatArray:
    """Return the values of n joints; NaN for a robot without a model."""
    return values if len(values) == n else np.full(n, np.nan)


def survey_robot(run: Path, model: Path | None) -> SurveyedRobot:
    """Return the state of one robot without its probes; this function runs in a worker process."""
    if model is None:
        return _without_friction(run, model, "it has no model: hil fleet fit")
    try:
        estimator, names, friction, temperature = _friction(run, model)
    except HilError as error:
        return _without_friction(run, model, error.message)
    # Estimators are plug-ins: any exception must affect only the robot of this model.
    except Exception as error:
        return _without_friction(run, model, f"its model failed: {type(error).__name__}: {error}")
    robot, age = robot_of(run), _age_years(run)
    return SurveyedRobot(robot, run, model, age, names, friction, temperature, estimator=estimator)


def _without_friction(run: Path, model: Path | None, problem: str) -> SurveyedRobot:
    none = np.empty(0)
    return SurveyedRobot(
        robot_of(run), run, model, _age_years(run), (), none, none, problem=problem
    )


DAYS_A_YEAR = 365.25


def _age_years(run: Path) -> float:
    """Return the years from the date `in_service` of the station to the run; NaN if unknown."""
    try:
        start = read_json(run / "start.json")
        station = load_station(run / "station.yaml", look_up=False)
        since = station.robots[str(start["robot_name"])].in_service
        day = datetime.fromisoformat(str(start["started"])).date()
    except (HilError, KeyError, ValueError):
        return float("nan")
    return float("nan") if since is None else (day - since).days / DAYS_A_YEAR


def _friction(run: Path, model: Path) -> tuple[str, tuple[str, ...], FloatArray, FloatArray]:
    """Return estimator, joint names, friction RMS (n,) [N·m] and mean temperature (n,) [°C]."""
    fitted = load_model_file(model)
    data = usable_part(load_source(run), fitted)
    prediction = fitted.predict(data)
    if "friction" not in prediction.components:
        raise FitError(f"{fitted.estimator} does not predict friction separately")
    torque = prediction.components["friction"] * fitted.torque_scale_
    measured = data.columns.get("temperature", np.full_like(torque, np.nan))
    friction = np.sqrt(_known_mean(torque**2))
    return fitted.estimator, fitted.joint_names_, friction, _known_mean(measured)


def _known_mean(values: FloatArray) -> FloatArray:
    """Return the mean (n,) of the known values in (N, n); NaN for a joint without known values."""
    known = np.count_nonzero(~np.isnan(values), axis=0)
    mean = np.full(known.shape, np.nan)
    np.divide(np.nansum(values, axis=0), known, out=mean, where=known > 0)
    return mean
