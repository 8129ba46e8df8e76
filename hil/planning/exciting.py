"""From the excitation of a spec to its program: plug-ins are loaded and given what they need."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import ArmDescription
from hil.core import plugins
from hil.dynamics import RobotModel
from hil.excitation import (
    Computes,
    Excitation,
    ExcitationCache,
    Program,
    Roadmap,
    Setting,
    Watch,
    Workspace,
    unwatched,
    user_cache,
)
from hil.spec import ExperimentSpec, StationRobot, WorkspaceInterlock


def program_of(
    spec: ExperimentSpec, roadmap: Roadmap, setting: Setting, folder: Path = Path()
) -> Program:
    """What a spec wants to be measured.

    Args:
        spec: Says which excitation.
        roadmap: How to get about with every load of the spec.
        setting: The robot, for an excitation that computes with its dynamics.
        folder: Where relative paths in the spec start.

    Raises:
        SpecError, PlanError: What the spec asks for cannot be.
        PluginError: The excitation is missing or does not load.
    """
    kind = plugins.load("hil.excitations", spec.excitation.kind)
    excitation: Excitation = kind(spec.excitation, folder)
    if isinstance(excitation, Computes):
        excitation.compute_with(setting)
    return excitation.program(roadmap)


def setting_of(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    workspace: Workspace,
    *,
    watch: Watch = unwatched,
    cache: ExcitationCache | None = None,
) -> Setting:
    """The robot of a spec at its station, as far as its dynamics go.

    Args:
        spec: Says which loads.
        station_robot: How the arm is mounted and what stands around it.
        arm: Its description.
        workspace: Where it may be, with every load of the spec.
        watch: Is told how far trajectories are that take long to compute.
        cache: Where those are kept; by default this user's.
    """
    collision: Any = workspace.collision  # a CollisionModel, which can do more than is asked of it
    return Setting(
        robot=RobotModel.from_arm(arm.name, gravity=station_robot.gravity_m_s2),
        effort_max=arm.effort_max,
        loads=tuple(load.payload() for load in spec.loads),
        collision=collision,
        identity=_confined(spec)
        | {
            "arm": {name: _plain(getattr(arm, name)) for name in _names(arm)},
            "surroundings": station_robot.surroundings.model_dump(mode="json"),
            "loads": [load.model_dump(mode="json", exclude={"prompt"}) for load in spec.loads],
        },
        cache=user_cache() if cache is None else cache,
        watch=watch,
    )


def _confined(spec: ExperimentSpec) -> dict[str, Any]:
    """Return what confines the flange, and nothing if it may go anywhere."""
    confining = [
        interlock.model_dump(mode="json")
        for interlock in spec.interlocks
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled
    ]
    return {"workspace": confining} if confining else {}


def _names(arm: ArmDescription) -> list[str]:
    """Of what an arm's motions depend on: all but where its numbers come from."""
    return [field.name for field in fields(arm) if field.name != "sources"]


def _plain(value: Any) -> Any:
    """A field of an arm's description as JSON."""
    return value.tolist() if isinstance(value, np.ndarray) else repr(value)
