"""How the robots of a fleet stand: drift, friction, temperature, age, and who stands out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.drift.history import Probe, assess, probes_of
from hil.errors import DataError, FitError, HilError
from hil.fleet.fitting import computed, robot_of
from hil.fleet.folder import MODELS, FleetFolder
from hil.fleet.outliers import FAMILY_WISE, Standing, standing
from hil.identify.model_folder import models_below
from hil.record.files import read_json
from hil.registry.registry import Registry
from hil.typing import FloatArray

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
        probe: The last probe of that name in the registry, None without.
        problem: Why nothing is known of its friction, else empty.
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


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A fleet of equal arms, and how its robots stand to one another.

    Attributes:
        name: Of the fleet.
        folder: Where it is kept.
        robots: Measured ones.
        missing: Names of the others.
        friction: In friction; None with too few robots.
        change: In friction as a share of their champions'; None with too few probes.
    """

    name: str
    folder: Path
    robots: tuple[Surveyed, ...]
    missing: tuple[str, ...]
    friction: Standing | None
    change: Standing | None

    @property
    def drifted(self) -> tuple[Surveyed, ...]:
        """Robots whose last probe says that they have changed."""
        return tuple(one for one in self.robots if one.probe is not None and one.probe.changed)

    def outlying(self, which: Standing | None) -> list[tuple[int, int]]:
        """(robot, joint) of what stands out in a quantity, the farthest first."""
        if which is None:
            return []
        order = np.argsort(-np.abs(np.nan_to_num(which.z)), axis=None)
        found = np.column_stack(np.unravel_index(order, which.z.shape))
        return [(int(i), int(j)) for i, j in found if which.outlying[i, j]]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil fleet report --json`."""
        return {
            "fleet": str(self.folder),
            "name": self.name,
            "family_wise": FAMILY_WISE,
            "joint_names": list(self.robots[0].joint_names) if self.robots else [],
            "robots": [_told(one) for one in self.robots],
            "missing": list(self.missing),
            "drifted": [one.robot for one in self.drifted],
            "friction": self._standing(self.friction),
            "change": self._standing(self.change),
        }

    def _standing(self, which: Standing | None) -> dict[str, Any] | None:
        if which is None:
            return None
        names = self.robots[0].joint_names
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
    """Look at every robot of a fleet that has been measured.

    Args:
        path: Folder of the fleet.
        registry: With the robots' probes; may be empty.
        workers: Processes.

    Raises:
        DataError: It is no fleet, nothing was measured, or its robots are different arms.
        FitError: Processes died again and again.
        RegistryError: A history of probes is damaged.
    """
    folder, members = FleetFolder.open(path)
    runs = completed(members)
    if not runs:
        raise DataError(
            f"no robot of {folder.path} has been measured", hint=f"hil fleet resume {folder.path}"
        )
    tasks = [partial(surveyed, run, _model_of(folder, run)) for run in runs]
    known = set(registry.names())
    robots = []
    for one in computed(tasks, workers, None, lambda done: None):
        probes = probes_of(registry, one.robot) if one.robot in known else []
        robots.append(_with_probe(one, probes[-1] if probes else None))
    if len({one.joint_names for one in robots if one.joint_names}) > 1:
        raise DataError(
            f"the robots of {folder.path} are different arms",
            hint="run a fleet of each: their friction cannot be compared",
        )
    n = max(len(one.joint_names) for one in robots)
    given = {
        "age": np.array([one.age for one in robots]),
        "temperature": np.array([_wide(one.temperature, n) for one in robots]),
    }
    return Survey(
        str(folder.head["name"]), folder.path, tuple(robots),
        tuple(one["robot"] for one in members if one.get("outcome") != "completed"),
        standing(np.array([_wide(one.friction, n) for one in robots]), given),
        standing(np.array([_wide(one.change, n) for one in robots]), given),
    )  # fmt: skip


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[tuple[str, Probe]]:
    """Judge the runs of a fleet as probes, each against its robot's champion.

    Args:
        path: Folder of the fleet.
        registry: With champions of the robots.
        false_alarm: Probability with which any of the robots is called changed though none is.

    Raises:
        DataError: It is no fleet, or a champion was fitted to a run.
        RegistryError: A robot has no champion, or a history is damaged.
    """
    runs = completed(FleetFolder.open(path)[1])
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, len(runs)))
    named = [(robot_of(run), run) for run in runs]
    return [(name, assess(registry, name, run, false_alarm=each)) for name, run in named]


def completed(members: Sequence[dict[str, Any]]) -> list[Path]:
    """Runs of a fleet's document that have measured all they should."""
    return [Path(one["run"]) for one in members if one.get("outcome") == "completed"]


def surveyed(run: Path, model: Path | None) -> Surveyed:
    """One robot, but for its probes; computed by a worker."""
    robot, age = robot_of(run), _age(run)
    try:
        if model is None:
            raise FitError("it has no model: hil fleet fit")
        names, friction, temperature = _friction(run, model)
    except HilError as error:
        none = np.empty(0)
        return Surveyed(robot, run, model, age, (), none, none, problem=error.message)
    return Surveyed(robot, run, model, age, names, friction, temperature)


def _friction(run: Path, model: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    from hil.data.load import load_source
    from hil.fitting import usable_part
    from hil.identify.model_file import load_model_file

    fitted = load_model_file(model)
    data = usable_part(load_source(run), fitted)
    prediction = fitted.predict(data)
    if "friction" not in prediction.components:
        raise FitError(f"{fitted.estimator} does not say which part of its prediction is friction")
    torque = prediction.components["friction"] * fitted.torque_scale_
    friction: FloatArray = np.sqrt(np.nanmean(torque**2, axis=0))
    measured = "temperature" in data.columns
    celsius = (
        np.nanmean(data["temperature"], axis=0) if measured else np.full(len(friction), np.nan)
    )
    return fitted.joint_names_, friction, celsius


def _age(run: Path) -> float:
    """Years from the station's `in_service` to the run; NaN where either is not told."""
    from hil.spec.load import load_station

    start = read_json(run / "start.json")
    try:
        station = load_station(run / "station.yaml", look_up=False)
        since = station.robots[str(start["robot_name"])].in_service
        day = datetime.fromisoformat(str(start["started"])).date()
    except (HilError, KeyError, ValueError):
        return float("nan")
    return float("nan") if since is None else (day - since).days / DAYS_A_YEAR


def _model_of(folder: FleetFolder, run: Path) -> Path | None:
    """The model fitted last: by `hil fleet fit` of this fleet, else by the run itself."""
    ours = [one.parent for one in (folder.path / MODELS / robot_of(run)).glob("*/model.json")]
    newest = max(ours, key=lambda one: (one / "model.json").stat().st_mtime, default=None)
    return newest or next(iter(models_below(run)), None)


def _with_probe(one: Surveyed, probe: Probe | None) -> Surveyed:
    return replace(one, probe=probe)


def _wide(values: FloatArray, n: int) -> FloatArray:
    return values if len(values) == n else np.full(n, np.nan)


def _told(one: Surveyed) -> dict[str, Any]:
    return {
        "robot": one.robot,
        "run": str(one.run),
        "model": one.model and str(one.model),
        "age_years": one.age,
        "friction_nm": one.friction.tolist(),
        "temperature_c": one.temperature.tolist(),
        "change": one.change.tolist(),
        "changed": one.probe.changed if one.probe else None,
        "what": one.probe.text if one.probe else None,
        "problem": one.problem or None,
    }
