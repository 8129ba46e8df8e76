"""How the robots of a fleet stand: drift, friction, temperature, age, and who stands out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray, HilError
from hil.estimators import models_below
from hil.models.drift.history import probes_of
from hil.models.fleet_fitting import computed
from hil.models.fleet_folder import MODELS, FleetFolder, completed
from hil.models.fleet_outliers import FAMILY_WISE, Standing, standing
from hil.models.fleet_robot_fit import robot_of
from hil.models.fleet_surveyed import Surveyed, surveyed
from hil.models.model_registry import Registry


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
    def joint_names(self) -> tuple[str, ...]:
        """Of the arms; empty where nobody has a model."""
        return next((one.joint_names for one in self.robots if one.joint_names), ())

    @property
    def drifted(self) -> tuple[Surveyed, ...]:
        """Robots whose last probe under their present champion says that they have changed."""
        return tuple(one for one in self.robots if one.probe is not None and one.probe.changed)

    @property
    def false_alarms(self) -> float:
        """Robots, at most, that are expected among `drifted` if nobody has changed.

        The sum of the rates at which their last probes were judged.
        """
        return sum(one.probe.false_alarm for one in self.robots if one.probe is not None)

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
            "joint_names": list(self.joint_names),
            "robots": [one.to_dict() for one in self.robots],
            "missing": list(self.missing),
            "drifted": [one.robot for one in self.drifted],
            "false_alarms": self.false_alarms,
            "friction": self._standing(self.friction),
            "change": self._standing(self.change),
        }

    def _standing(self, which: Standing | None) -> dict[str, Any] | None:
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
    """Look at every robot of a fleet that has been measured.

    Args:
        path: Folder of the fleet.
        registry: With the robots' probes; may be empty.
        workers: Processes.

    Raises:
        DataError: It is no fleet, nothing was measured, or its robots are different arms.
        FitError: Processes died again and again.
    """
    folder, members = FleetFolder.open(path)
    runs = completed(members)
    if not runs:
        raise DataError(
            f"no robot of {folder.path} has been measured", hint=f"hil fleet resume {folder.path}"
        )
    tasks = [partial(surveyed, run, _model_of(folder, run)) for run in runs]
    known = set(registry.names())
    found: list[Surveyed] = computed(tasks, workers, None, lambda done: None)
    robots = [_probed(one, registry) if one.robot in known else one for one in found]
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


def _model_of(folder: FleetFolder, run: Path) -> Path | None:
    """The model fitted last: by `hil fleet fit` of this fleet, else by the run itself."""
    ours = [one.parent for one in (folder.path / MODELS / robot_of(run)).glob("*/model.json")]
    newest = max(ours, key=lambda one: (one / "model.json").stat().st_mtime, default=None)
    return newest or next(iter(models_below(run)), None)


def _probed(one: Surveyed, registry: Registry) -> Surveyed:
    """With its last probe under the present champion: one before is of another model's errors."""
    try:
        champion = registry.aliases(one.robot).champion
        probes = [each for each in probes_of(registry, one.robot) if each.champion == champion]
    except HilError as error:  # a damaged history is this robot's alone
        return replace(one, problem="; ".join(filter(None, (one.problem, error.message))))
    return replace(one, probe=probes[-1] if probes else None)


def _wide(values: FloatArray, n: int) -> FloatArray:
    return values if len(values) == n else np.full(n, np.nan)
