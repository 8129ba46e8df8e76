"""What several checks of a robot assert."""

from __future__ import annotations

import time
from collections.abc import Callable

from hil.core import HilError
from hil.robot import Robot

STOP_S = 0.1
"""Wall time that `stop` may take, and the command until it is with the controller [s]."""


def raises(kind: type[HilError], call: Callable[[], object], what: str) -> None:
    """A call has to raise an error of this kind.

    Raises:
        AssertionError: It raises another one, or none.
    """
    try:
        call()
    except kind:
        return
    except Exception as error:
        raise AssertionError(
            f"{what} raised {type(error).__name__}, not {kind.__name__}"
        ) from error
    raise AssertionError(f"{what} did not raise {kind.__name__}")


def stop_in_time(robot: Robot, when: str) -> None:
    """Call `stop`.

    Raises:
        AssertionError: It takes too long.
    """
    asked = time.perf_counter()
    robot.stop()
    took = time.perf_counter() - asked
    assert took < STOP_S, f"stop {when} took {took * 1e3:.0f} ms"
