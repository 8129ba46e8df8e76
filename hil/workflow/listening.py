"""Recording a robot that somebody else drives: a run directory with steps found, not planned."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hil.core import PluginError, SpecError, did_you_mean, hold_run
from hil.engine import SignalWatch
from hil.planning import BUILT_IN, close_robot, find_station, open_robot
from hil.recording import RunDirectory
from hil.robot import Listens, Robot
from hil.spec import Station, StationRobot
from hil.workflow.listened import Listened, Wanted
from hil.workflow.listening_files import write_start
from hil.workflow.listening_run import ListeningRun


def listen(
    wanted: Wanted, *, station: Path | None, runs: Path, tell: Callable[[str], object]
) -> Listened:
    """Record a robot without driving it.

    Args:
        wanted: What, and until when.
        station: Station file; by default as for `hil run`, from the present folder.
        runs: Where run directories are kept.
        tell: Is told how it goes, a line at a time.

    Raises:
        SpecError: The station has no such robot.
        PluginError: Its driver cannot listen.
        RobotError: It cannot be reached.
        RecordingError: The run directory cannot be made, or its end not be written.
    """
    bench, text, source = find_station(Path.cwd(), station)
    entry = _entry(bench, wanted.robot)
    # In this process, whatever the station says: there is no arm that would have to be stopped.
    robot = open_robot(wanted.robot, entry.model_copy(update={"own_process": False}))
    with SignalWatch() as signals:
        try:
            require_listener(robot, entry.driver).listen()
            with signals.guard():
                directory = RunDirectory.create(
                    runs,
                    wanted.robot,
                    wanted.name,
                    begin=lambda draft: write_start(
                        draft, wanted, robot, entry, text or f"# {BUILT_IN}\n", source
                    ),
                )
                with hold_run(directory.path):
                    tell(f"recording → {directory.path}")
                    return ListeningRun(directory, wanted, robot, signals, tell).run()
        finally:
            close_robot(robot)


def require_listener(robot: Robot, driver: str) -> Listens:
    """The robot as one that can be listened to.

    Raises:
        PluginError: Its driver has not opted into `hil.robot.Listens`.
    """
    if isinstance(robot, Listens):
        return robot
    raise PluginError(
        f"the driver {driver!r} cannot record a robot that it does not drive",
        hint="record a program of hil's own with: hil run SPEC",
    )


def _entry(bench: Station, name: str) -> StationRobot:
    entry = bench.robots.get(name)
    if entry is None:
        raise SpecError(
            f"the station {bench.name!r} has no robot {name!r}",
            hint=did_you_mean(name, bench.robots) + " (or choose another --station)",
        )
    return entry
