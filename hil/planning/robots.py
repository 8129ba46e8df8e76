"""Access to the robot of a station: open, lease, connect and close the robot, and read its pose."""

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
"""Maximum time for a driver to disconnect from a robot that is static or decelerating [s]."""


@runtime_checkable
class Simulated(Protocol):
    """Interface of a simulated robot, whose mounting orientation has to be set."""

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set the gravity vector in the base frame [m/s²]; to be called before `connect`."""


def open_robot(name: str, station_robot: StationRobot) -> Robot:
    """Return the robot that a driver creates, without connecting to it.

    A simulated robot is set to the mounting orientation in the station file. The driver possibly
    runs in a separate process, so the robot has to be closed even if it was never connected.

    Raises:
        PluginError: The driver does not exist, or cannot be loaded.
        SpecError: The driver does not accept the options of the station, or the options contradict
            the gravity vector of the station.
        RobotError: The separate process of the driver does not start.
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
    """Open a robot, and close the robot when the context ends.

    Errors while closing the robot are not raised, because they would hide an earlier error or
    invalidate a completed run. `close_robot` returns the errors while closing as texts.
    """
    robot = open_robot(name, station_robot)
    try:
        yield robot
    finally:
        close_robot(robot)


def moves_for_real(experiment: Experiment) -> bool:
    """Return whether the motion of an experiment has to be confirmed, without connecting.

    Raises:
        SpecError, PluginError: The robot cannot be opened.
    """
    with opened(experiment.spec.robot, experiment.robot) as robot:
        return address_of(robot).real


@contextlib.contextmanager
def connected(name: str, station_robot: StationRobot) -> Iterator[Robot]:
    """Open a robot, connect to it, and close it when the context ends; see `opened`."""
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
    """Lease the robot of an experiment for this process and connect to it, within the context.

    Args:
        experiment: Experiment, which names robot and station.
        wait_s: Maximum time to wait until a different process releases the robot [s].
        report: Callback that is called one time with the present lease holder.
        admit: Callback that is called with the robot before leasing and connecting; raises an error
            to refuse the robot.
        robot: Robot that is already open; by default, this function opens the robot.

    Raises:
        RobotConnectionError: A different process uses the robot, or the robot cannot be reached.
        PluginError, SpecError, RobotError: The robot cannot be opened, see `open_robot`.
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
    """Lease an open robot and connect to it; at the end, disconnect and release the lease."""
    name, station = experiment.spec.robot, experiment.station_source
    driver = experiment.robot.driver
    with leased(
        robot, name=name, driver=driver, station=station, wait_s=wait_s, tell=tell
    ) as lease:
        try:
            robot.connect()
            yield lease
        finally:
            close_robot(robot)  # before releasing the lease: a waiting process connects at once


def close_robot(robot: Robot) -> list[str]:
    """Close a robot and return error messages; a robot that is already closed may be passed."""
    try:
        bounded(robot.close, CLOSE_WITHIN_S, "closing the robot")
    except Exception as error:  # a driver may raise any error
        return [f"closing the robot: {error}"]
    return []


def plan_for(experiment: Experiment, robot: Robot, watch: Watch = unwatched) -> Plan:
    """Return the plan that starts at the present pose of the robot, with the rate of the robot.

    Args:
        experiment: Experiment with spec and station.
        robot: Connected robot.
        watch: Callback that receives the progress of long computations of trajectories.

    Raises:
        PlanError: No safe plan exists for the spec.
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
    """Return the set-point that each joint of the robot holds.

    If set-point and measured position of a joint differ by 0.01 rad or more, the measured position
    is returned for this joint.
    """
    q, target = np.array(row["q"]), np.array(row["q_target"])
    holds = np.abs(q - target) < AT_SET_POINT_RAD
    return np.where(holds, target, q)
