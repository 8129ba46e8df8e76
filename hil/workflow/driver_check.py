"""Does the driver accept what the station says about its robot, and can its arm do what is asked?

Asked before anything connects.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from hil.core import SpecError
from hil.planning import Experiment, opened
from hil.robot import Capabilities, Robot
from hil.workflow.arm_check import require_within_reach


def check_driver(experiment: Experiment) -> Capabilities:
    """Construct the robot's driver, and nothing more: no connection, no motion.

    Returns:
        What the robot offers.

    Raises:
        SpecError, PluginError: See `checked_robot`.
    """
    with checked_robot(experiment) as robot:
        return robot.capabilities


@contextlib.contextmanager
def checked_robot(experiment: Experiment) -> Iterator[Robot]:
    """Open the robot, not connected, for a run whose arm can do what is asked; close it after it.

    Raises:
        SpecError: The driver refuses its options; the message names the station's file and robot.
            Or the arm cannot do what the spec asks; the message names every place in its file.
        PluginError: There is no such driver, or it does not load.
    """
    name = experiment.spec.robot
    place = f"{experiment.station_source}: robots.{name}"
    with contextlib.ExitStack() as until_closed:
        try:
            robot = until_closed.enter_context(opened(name, experiment.robot))
            can = robot.capabilities
        except SpecError as error:
            raise SpecError(f"{place}: {error.message}", hint=error.hint) from error
        except (TypeError, ValueError) as error:
            # What Python itself says when a constructor is called with an option it does not have.
            given = ", ".join(experiment.robot.options) or "none"
            raise SpecError(
                f"{place}: the driver {experiment.robot.driver!r} does not accept its options "
                f"({given}): {error}",
                hint="see the driver's documentation for its options",
            ) from error
        require_within_reach(experiment, can)
        yield robot
