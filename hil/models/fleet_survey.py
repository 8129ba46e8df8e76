"""The state of every robot of a fleet: drift, friction, temperature and age, and its outliers.

`survey_fleet` reads the last probe, the friction of the last model and the temperature of every
robot, and compares the robots joint by joint (`fleet_outliers`). Friction is compared only between
models of one estimator. `fleet_probes` makes the probes.
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
    """The state of one robot.

    Attributes:
        robot: Its name.
        run: Its run for this fleet.
        model: Folder of the model fitted to that run; None without one.
        age: Years in service on the day of the run; NaN if the station has no `in_service`.
        joint_names: Length n.
        friction: (n,) RMS of the friction component over the series that the estimator is fitted to
            [N·m].
        temperature: (n,) mean of the joints in the same part of the run [°C]; NaN if not measured.
        probe: The last probe under its present champion; None without one.
        problem: Why it is missing or not compared; empty if nothing is wrong.
        estimator: Name of the model's estimator; empty without a model.
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
        """(n,) friction now as a share of the champion's, by the last probe; NaN without one."""
        if self.probe is None:
            return np.full(len(self.joint_names), np.nan)
        values = dict(zip(self.probe.features.names, self.probe.features.values, strict=True))
        return np.array([1.0 + values.get(f"{name} friction", np.nan) for name in self.joint_names])

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `hil fleet report --json`."""
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
    """A fleet of equal arms, and its robots compared with one another.

    Attributes:
        name: Of the fleet.
        folder: Of the fleet.
        robots: The measured ones.
        missing: Names of the others.
        friction: Comparison of their friction; None with too few robots.
        change: Comparison of their friction as a share of their champions'; None with too few
            probes.
    """

    name: str
    folder: Path
    robots: tuple[SurveyedRobot, ...]
    missing: tuple[str, ...]
    friction: Comparison | None
    change: Comparison | None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the arms; empty if no robot has a model."""
        return next((robot.joint_names for robot in self.robots if robot.joint_names), ())

    @property
    def drifted(self) -> tuple[SurveyedRobot, ...]:
        """Robots that have changed by their last probe under their present champion."""
        return tuple(robot for robot in self.robots if robot.probe and robot.probe.changed)

    @property
    def false_alarms(self) -> float:
        """Number of robots, at most, that are expected among `drifted` if none has changed.

        It is the sum of the rates at which their last probes were judged.
        """
        return sum(robot.probe.false_alarm for robot in self.robots if robot.probe is not None)

    def outlying(self, which: Comparison | None) -> list[tuple[int, int]]:
        """Return (robot, joint) of the outliers in a quantity, the farthest first."""
        if which is None:
            return []
        order = np.argsort(-np.abs(np.nan_to_num(which.z)), axis=None)
        places = np.column_stack(np.unravel_index(order, which.z.shape))
        return [(int(i), int(j)) for i, j in places if which.outlying[i, j]]

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil fleet report --json`."""
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
    """Return the state of every robot of a fleet that has been measured.

    Args:
        path: Folder of the fleet.
        registry: With the robots' probes; may be empty.
        workers: Processes.

    Raises:
        DataError: It is no fleet, nothing was measured, or its robots are different arms.
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
            hint="run a fleet of each: their friction cannot be compared",
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
    """Return the newest model by `hil fleet fit` of this fleet, else the run's first by name."""
    files = (fleet.models / robot_of(run)).glob("*/model.json")
    newest = max(files, key=lambda file: file.stat().st_mtime, default=None)
    return newest.parent if newest else next(iter(models_below(run)), None)


def _of_one_estimator(robots: list[SurveyedRobot]) -> list[SurveyedRobot]:
    """Drop the friction of robots whose model is not of the commonest estimator.

    Estimators attribute different parts of the effort to friction.
    """
    named = Counter(robot.estimator for robot in robots if robot.estimator)
    if len(named) < 2:
        return robots
    ((common, _),) = named.most_common(1)
    return [
        replace(
            robot,
            friction=np.full_like(robot.friction, np.nan),
            problem=f"its friction is not compared: its model is of {robot.estimator}, "
            f"others are of {common} (hil fleet fit FOLDER -e ESTIMATOR)",
        )
        if robot.estimator not in ("", common)
        else robot
        for robot in robots
    ]


def _with_last_probe(robot: SurveyedRobot, registry: Registry) -> SurveyedRobot:
    """Return a robot with its last probe under the present champion; other probes say nothing."""
    try:
        champion = registry.aliases(robot.robot).champion
        probes = [each for each in probes_of(registry, robot.robot) if each.champion == champion]
    except HilError as error:  # a damaged history is this robot's alone
        return replace(robot, problem="; ".join(filter(None, (robot.problem, error.message))))
    return replace(robot, probe=probes[-1] if probes else None)


def _or_nan(values: FloatArray, n: int) -> FloatArray:
    """Return values of n joints; NaN for a robot without a model."""
    return values if len(values) == n else np.full(n, np.nan)


def survey_robot(run: Path, model: Path | None) -> SurveyedRobot:
    """Return the state of one robot without its probes; computed by a worker."""
    if model is None:
        return _without_friction(run, model, "it has no model: hil fleet fit")
    try:
        estimator, names, friction, temperature = _friction(run, model)
    except HilError as error:
        return _without_friction(run, model, error.message)
    # Estimators are plug-ins: one that breaks down must not cost the other robots.
    except Exception as error:
        return _without_friction(
            run, model, f"its model broke down: {type(error).__name__}: {error}"
        )
    robot, age = robot_of(run), _age_years(run)
    return SurveyedRobot(robot, run, model, age, names, friction, temperature, estimator=estimator)


def _without_friction(run: Path, model: Path | None, problem: str) -> SurveyedRobot:
    none = np.empty(0)
    return SurveyedRobot(
        robot_of(run), run, model, _age_years(run), (), none, none, problem=problem
    )


DAYS_A_YEAR = 365.25


def _age_years(run: Path) -> float:
    """Return the years from the station's `in_service` to the run; NaN if either is unknown."""
    try:
        start = read_json(run / "start.json")
        station = load_station(run / "station.yaml", look_up=False)
        since = station.robots[str(start["robot_name"])].in_service
        day = datetime.fromisoformat(str(start["started"])).date()
    except (HilError, KeyError, ValueError):
        return float("nan")
    return float("nan") if since is None else (day - since).days / DAYS_A_YEAR


def _friction(run: Path, model: Path) -> tuple[str, tuple[str, ...], FloatArray, FloatArray]:
    """Return the estimator, joint names, (n,) RMS of friction [N·m] and mean temperature [°C]."""
    fitted = load_model_file(model)
    data = usable_part(load_source(run), fitted)
    prediction = fitted.predict(data)
    if "friction" not in prediction.components:
        raise FitError(f"{fitted.estimator} does not say which part of its prediction is friction")
    torque = prediction.components["friction"] * fitted.torque_scale_
    measured = data.columns.get("temperature", np.full_like(torque, np.nan))
    friction = np.sqrt(_known_mean(torque**2))
    return fitted.estimator, fitted.joint_names_, friction, _known_mean(measured)


def _known_mean(values: FloatArray) -> FloatArray:
    """(n,) mean over the rows (N, n) that are known; NaN for a joint without any."""
    known = np.count_nonzero(~np.isnan(values), axis=0)
    mean = np.full(known.shape, np.nan)
    np.divide(np.nansum(values, axis=0), known, out=mean, where=known > 0)
    return mean
