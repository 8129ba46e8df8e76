"""The station's robot: opened, connected, and where it stands."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np

from hil.core import FloatArray, bounded, plugins
from hil.excitation import Watch, unwatched
from hil.planning.build import build_plan
from hil.planning.experiment import Experiment
from hil.planning.plan import Plan
from hil.robot import Lease, Robot, RobotProcess, address_of, leased
from hil.spec import StationRobot

AT_SET_POINT_RAD = 0.01

CLOSE_WITHIN_S = 15.0
"""What a driver may take to let a robot go, its arm being at rest or on the way there [s]."""


@runtime_checkable
class Simulated(Protocol):
    """A robot that must be told how it is mounted: a real one feels it."""

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Gravity in the base frame, before `connect`."""


def open_robot(name: str, station_robot: StationRobot) -> Robot:
    """The driver's robot, not yet connected; a simulated one is mounted as the station says.

    It may have a process of its own already: close it, even if it was never connected.

    Raises:
        PluginError: There is no such driver, or it does not load.
        SpecError: The driver does not accept the station's options, or they contradict its gravity.
        RobotError: The process for it does not come up.
    """
    if station_robot.own_process:
        return RobotProcess(
            station_robot.driver,
            name,
            station_robot.model,
            station_robot.options,
            gravity_m_s2=station_robot.gravity_m_s2,
        )
    driver = plugins.load("hil.drivers", station_robot.driver)
    robot: Robot = driver(name, station_robot.model, **station_robot.options)
    if isinstance(robot, Simulated):
        robot.set_gravity(station_robot.gravity_m_s2)
    return robot


@contextlib.contextmanager
def opened(name: str, station_robot: StationRobot) -> Iterator[Robot]:
    """What `open_robot` gives, closed on every way out.

    What goes wrong in closing is not raised: it would hide what happened before, or take a
    finished run back. `close_robot` says what it was.
    """
    robot = open_robot(name, station_robot)
    try:
        yield robot
    finally:
        close_robot(robot)


def moves_for_real(experiment: Experiment) -> bool:
    """Return whether the motion of an experiment has to be confirmed; nothing is connected.

    Raises:
        SpecError, PluginError: The robot cannot be opened.
    """
    with opened(experiment.spec.robot, experiment.robot) as robot:
        return address_of(robot).real


@contextlib.contextmanager
def connected(name: str, station_robot: StationRobot) -> Iterator[Robot]:
    """The robot, connected while inside and closed on every way out; see `opened`."""
    with opened(name, station_robot) as robot:
        robot.connect()
        yield robot


@contextlib.contextmanager
def held(
    experiment: Experiment,
    *,
    wait_s: float = 0.0,
    report: Callable[[str], object],
    admit: Callable[[Robot], object] = lambda robot: None,
    robot: Robot | None = None,
) -> Iterator[tuple[Robot, Lease]]:
    """The experiment's robot, connected and leased while inside: no other process has it.

    Args:
        experiment: Says which robot of which station.
        wait_s: How long to wait for another process to release it [s].
        report: Called once with the current lease holder.
        admit: Called with the robot before it is leased and connected; may refuse it by raising.
        robot: The robot, if it is open already; else it is opened here.

    Raises:
        RobotConnectionError: Another process holds the robot, or it cannot be reached.
        PluginError, SpecError, RobotError: See `open_robot`.
    """
    with contextlib.ExitStack() as until_closed:
        if robot is None:
            robot = until_closed.enter_context(opened(experiment.spec.robot, experiment.robot))
        admit(robot)
        with leased_and_connected(experiment, robot, wait_s=wait_s, tell=report) as lease:
            yield robot, lease


@contextlib.contextmanager
def leased_and_connected(
    experiment: Experiment,
    robot: Robot,
    *,
    wait_s: float = 0.0,
    tell: Callable[[str], object] = lambda text: None,
) -> Iterator[Lease]:
    """Lease an open robot, then connect it; release both in the opposite order."""
    name, station = experiment.spec.robot, experiment.station_source
    driver = experiment.robot.driver
    with leased(
        robot, name=name, driver=driver, station=station, wait_s=wait_s, tell=tell
    ) as lease:
        try:
            robot.connect()
            yield lease
        finally:
            close_robot(robot)  # while it is still ours: whoever waits for it connects at once


def close_robot(robot: Robot) -> list[str]:
    """Close a robot (again, if need be); returns what went wrong."""
    try:
        bounded(robot.close, CLOSE_WITHIN_S, "closing the robot")
    except Exception as error:  # a driver may fail in any way it likes
        return [f"closing the robot: {error}"]
    return []


def plan_for(experiment: Experiment, robot: Robot, watch: Watch = unwatched) -> Plan:
    """The plan from where the robot stands now, at the robot's own rate.

    Args:
        experiment: Says what is wanted.
        robot: Connected.
        watch: Is told how far trajectories are that take long to compute.

    Raises:
        PlanError: No safe plan follows from the spec.
    """
    newest = robot.read()[-1]
    return build_plan(
        experiment.spec,
        experiment.robot,
        start_q=standing_at(newest),
        rate_hz=robot.capabilities.rate_hz,
        watch=watch,
        part=experiment.commissioning,
    )


def standing_at(row: np.void) -> FloatArray:
    """The set-point the robot holds, or where it is when it holds none that makes sense."""
    q, target = np.array(row["q"]), np.array(row["q_target"])
    holds = np.abs(q - target) < AT_SET_POINT_RAD
    return np.where(holds, target, q)
