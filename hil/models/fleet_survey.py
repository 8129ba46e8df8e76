"""The state of every robot of a fleet: drift, friction, temperature and age, and its outliers.

`survey_fleet` reads the last probe, the friction of the last model and the temperature of every
robot, and compares the robots joint by joint (`fleet_outliers`). `probe_fleet` judges the runs of a
fleet as probes, each against its robot's champion, at such a rate of false alarms that the rate of
the whole fleet is the one asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray, HilError, read_json
from hil.estimators import load_model_file, models_below
from hil.evaluation import usable_part
from hil.importers import load_source
from hil.models.drift import Probe, assess, probes_of
from hil.models.fleet_fits import results_of, robot_of
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
        friction: (n,) RMS of the friction by the model, along the run's trajectories [N·m].
        temperature: (n,) mean of the joints in the run [°C]; NaN if not measured.
        probe: The last probe under its present champion; None without one.
        problem: What could not be read of it; empty if all could.
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
        return next((one.joint_names for one in self.robots if one.joint_names), ())

    @property
    def drifted(self) -> tuple[SurveyedRobot, ...]:
        """Robots that have changed by their last probe under their present champion."""
        return tuple(one for one in self.robots if one.probe is not None and one.probe.changed)

    @property
    def false_alarms(self) -> float:
        """Number of robots, at most, that are expected among `drifted` if none has changed.

        It is the sum of the rates at which their last probes were judged.
        """
        return sum(one.probe.false_alarm for one in self.robots if one.probe is not None)

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
            "robots": [one.to_dict() for one in self.robots],
            "missing": list(self.missing),
            "drifted": [one.robot for one in self.drifted],
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
        FitError: Processes died again and again.
    """
    fleet = FleetGroup.open(path)
    runs = fleet.completed()
    if not runs:
        raise DataError(
            f"no robot of {fleet.path} has been measured", hint=f"hil fleet resume {fleet.path}"
        )
    tasks = [partial(survey_robot, run, _model_of(fleet, run)) for run in runs]
    registered = set(registry.names())
    robots: list[SurveyedRobot] = results_of(tasks, workers, None, lambda done: None)
    robots = [_with_last_probe(one, registry) if one.robot in registered else one for one in robots]
    if len({one.joint_names for one in robots if one.joint_names}) > 1:
        raise DataError(
            f"the robots of {fleet.path} are different arms",
            hint="run a fleet of each: their friction cannot be compared",
        )
    n = max(len(one.joint_names) for one in robots)
    covariates = {
        "age": np.array([one.age for one in robots]),
        "temperature": np.array([_wide(one.temperature, n) for one in robots]),
    }
    return Survey(
        str(fleet.head["name"]), fleet.path, tuple(robots),
        tuple(one.robot for one in fleet.members() if one.report.get("outcome") != "completed"),
        compare_robots(np.array([_wide(one.friction, n) for one in robots]), covariates),
        compare_robots(np.array([_wide(one.change, n) for one in robots]), covariates),
    )  # fmt: skip


def _model_of(fleet: FleetGroup, run: Path) -> Path | None:
    """Return the model fitted last: by `hil fleet fit` of this fleet, else by the run itself."""
    files = (fleet.models / robot_of(run)).glob("*/model.json")
    newest = max(files, key=lambda file: file.stat().st_mtime, default=None)
    return newest.parent if newest else next(iter(models_below(run)), None)


def _with_last_probe(one: SurveyedRobot, registry: Registry) -> SurveyedRobot:
    """Return a robot with its last probe under the present champion; other probes say nothing."""
    try:
        champion = registry.aliases(one.robot).champion
        probes = [each for each in probes_of(registry, one.robot) if each.champion == champion]
    except HilError as error:  # a damaged history is this robot's alone
        return replace(one, problem="; ".join(filter(None, (one.problem, error.message))))
    return replace(one, probe=probes[-1] if probes else None)


def _wide(values: FloatArray, n: int) -> FloatArray:
    """Return values of n joints; NaN for a robot without a model."""
    return values if len(values) == n else np.full(n, np.nan)


def survey_robot(run: Path, model: Path | None) -> SurveyedRobot:
    """Return the state of one robot without its probes; computed by a worker."""
    robot, age = robot_of(run), _age_years(run)
    try:
        if model is None:
            raise FitError(
                "it has no model: hil fleet fit",
                hint="fit it first: hil fleet fit FOLDER -e ESTIMATOR",
            )
        names, friction, temperature = _friction(run, model)
    except HilError as error:
        none = np.empty(0)
        return SurveyedRobot(robot, run, model, age, (), none, none, problem=error.message)
    return SurveyedRobot(robot, run, model, age, names, friction, temperature)


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


def _friction(run: Path, model: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Return joint names, (n,) RMS of friction [N·m] and (n,) mean temperature [°C] of a run."""
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


@dataclass(frozen=True, slots=True, eq=False)
class RobotProbe:
    """The probe of one robot of a fleet.

    Attributes:
        robot: Its name.
        asked: Rate of false alarms asked for it, so that the fleet's is the one asked for.
        probe: None if the robot could not be judged.
        error: Why not, else empty.
    """

    robot: str
    asked: float
    probe: Probe | None = None
    error: str = ""

    @property
    def note(self) -> str:
        """A note if the probe was judged earlier, at another rate of false alarms; else empty."""
        if self.probe is None or math.isclose(self.probe.false_alarm, self.asked, rel_tol=1e-9):
            return ""
        return f"judged before, at a rate of {self.probe.false_alarm:.2g}, not {self.asked:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `hil fleet drift --json`."""
        probe = {} if self.probe is None else self.probe.to_dict()
        more = {"asked": self.asked, "note": self.note or None, "error": self.error or None}
        return {"robot": self.robot, **probe, **more}


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[RobotProbe]:
    """Judge the runs of a fleet as probes; one that cannot be judged leaves the others alone.

    Args:
        path: Folder of the fleet.
        registry: With champions of the robots.
        false_alarm: Probability with which any of the robots is called changed if none is:
            nominally, for independent probes that are judged now.

    Raises:
        DataError: It is no fleet.
    """
    runs = FleetGroup.open(path).completed()
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, len(runs)))
    return [_probe_robot(registry, run, each) for run in runs]


def _probe_robot(registry: Registry, run: Path, false_alarm: float) -> RobotProbe:
    robot = robot_of(run)
    try:
        return RobotProbe(robot, false_alarm, assess(registry, robot, run, false_alarm=false_alarm))
    except HilError as error:
        return RobotProbe(robot, false_alarm, error=error.message)
