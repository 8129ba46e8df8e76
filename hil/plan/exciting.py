"""From the excitation of a spec to its program: plug-ins are loaded and given what they need."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil import plugins
from hil.arms import ArmDescription
from hil.excite.cache import ExcitationCache, user_cache
from hil.excite.roadmap import Roadmap
from hil.excite.setting import Computes, Setting, Watch, unwatched
from hil.excite.visit import Excitation, Program
from hil.spec.experiment import ExperimentSpec
from hil.spec.station import StationRobot

if TYPE_CHECKING:
    from hil.excite.optimise import Distances


def program_of(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    roadmap: Roadmap,
    *,
    folder: Path = Path(),
    watch: Watch = unwatched,
    cache: ExcitationCache | None = None,
) -> Program:
    """What a spec wants to be measured.

    Args:
        spec: Says which excitation.
        station_robot: How the arm is mounted and what stands around it.
        arm: Its description.
        roadmap: How to get about with every load of the spec.
        folder: Where relative paths in the spec start.
        watch: Is told how far trajectories are that take long to compute.
        cache: Where those are kept; by default this user's.

    Raises:
        SpecError, PlanError: What the spec asks for cannot be.
        PluginError: The excitation is missing or does not load.
    """
    kind = plugins.load("hil.excitations", spec.excitation.kind)
    excitation: Excitation = kind(spec.excitation, folder)
    if isinstance(excitation, Computes):
        distances: Any = roadmap.workspace.collision
        kept = user_cache() if cache is None else cache
        excitation.compute_with(_setting(spec, station_robot, arm, distances, kept, watch))
    return excitation.program(roadmap)


def _setting(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    collision: Distances,
    cache: ExcitationCache,
    watch: Watch,
) -> Setting:
    from hil.dynamics import RobotModel

    return Setting(
        robot=RobotModel.from_arm(arm.name, gravity=station_robot.gravity_m_s2),
        effort_max=arm.effort_max,
        loads=tuple(load.payload() for load in spec.loads),
        collision=collision,
        identity={
            "arm": {field.name: _plain(getattr(arm, field.name)) for field in fields(arm)},
            "surroundings": station_robot.surroundings.model_dump(mode="json"),
            "loads": [load.model_dump(mode="json", exclude={"prompt"}) for load in spec.loads],
        },
        cache=cache,
        watch=watch,
    )


def _plain(value: Any) -> Any:
    """A field of an arm's description as JSON."""
    return value.tolist() if isinstance(value, np.ndarray) else repr(value)
