"""Search for the robot of a station that matches a model, with its surroundings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.core import SpecError, did_you_mean
from hil.estimators import RobotEstimator
from hil.planning import BUILT_IN, find_station
from hil.spec import StationRobot

GRAVITY_TOLERANCE = 0.05
"""Maximum difference of two gravity vectors for mountings that count as equal [m/s²]."""


def place_of(
    model: RobotEstimator, station: Path | None, robot: str | None
) -> tuple[StationRobot, str]:
    """Return the robot of the model in its station, and a description of its surroundings.

    Raises:
        SpecError: The station has no such robot, several such robots, or the robot is a different
            arm.
    """
    described_station, _, source = find_station(Path().resolve(), station)
    robots = described_station.robots
    kind = model.robot_.name
    if robot is not None:
        if robot not in robots:
            raise SpecError(
                f"the station {described_station.name!r} has no robot {robot!r}",
                hint=did_you_mean(robot, robots) + " (or choose another --station)",
            )
        _require_same_arm(model, robot, robots[robot])
        return robots[robot], f"{robot} of {source}"
    fitting = [
        name for name, one in robots.items() if one.model == kind and _same_mount(model, one)
    ]
    if source == BUILT_IN or (station is None and not fitting):
        gravity = model.robot_.gravity_vector.tolist()
        alone = StationRobot(driver="mock", model=kind, gravity_m_s2=tuple(gravity))
        return alone, "a table at its base (no station was named)"
    if len(fitting) != 1:
        listed = ", ".join(fitting) or "none"
        raise SpecError(
            f"{source}: robots of model {kind} with the mounting of the fitted model: {listed}",
            hint="choose one with --robot NAME" if fitting else "choose another --station",
        )
    return robots[fitting[0]], f"{fitting[0]} of {source}"


def _require_same_arm(model: RobotEstimator, name: str, robot: StationRobot) -> None:
    if robot.model != model.robot_.name:
        raise SpecError(
            f"the model is for a {model.robot_.name}, but {name} is a {robot.model}",
            hint="choose the robot the model was fitted for",
        )
    if not _same_mount(model, robot):
        raise SpecError(
            f"the model is for gravity {model.robot_.gravity_vector.tolist()} m/s² in the base "
            f"frame, {name} is mounted under {list(robot.gravity_m_s2)}",
            hint="fit a model of this arm: its mounting differs",
        )


def _same_mount(model: RobotEstimator, robot: StationRobot) -> bool:
    given, known = np.array(robot.gravity_m_s2), model.robot_.gravity_vector
    return bool(np.allclose(given, known, atol=GRAVITY_TOLERANCE))
