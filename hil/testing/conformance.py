"""Does a driver keep the contract of `hil.robot.Robot`? One function, for tests of any driver.

>>> from hil.testing.conformance import robot_conformance
>>> robot_conformance(lambda: MyArm("bench", "ur5", address="192.0.2.7"))     # doctest: +SKIP
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from hil.core import HilError
from hil.robot import Robot
from hil.testing.bench import Bench
from hil.testing.moves import settle
from hil.testing.robot_checks import (
    BEFORE_AND_AFTER,
    BENCH,
    CONNECTED,
    FAULTY,
    SEEN,
    BenchCheck,
    Check,
)

MakeRobot = Callable[[], Robot]


class Conformance(Protocol):
    """What the fixture `robot_conformance` gives: the function below."""

    def __call__(
        self, make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
    ) -> tuple[str, ...]:
        """See `robot_conformance`."""


class NotConforming(AssertionError):
    """A driver breaks the contract; the message lists every check that found so.

    Attributes:
        failures: Name of the check → what it found.
    """

    def __init__(self, failures: dict[str, str]) -> None:
        super().__init__("".join(f"\n{name}: {found}" for name, found in failures.items()))
        self.failures = failures


def robot_conformance(
    make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
) -> tuple[str, ...]:
    """Check a driver against the robot protocol, moving its last joint by up to 0.4 rad at a time.

    Args:
        make_robot: Gives a robot that is not connected, a fresh one each time. It is connected,
            moved, stopped and closed; a real one needs room around it.
        leave_out: Checks that are not done.
        bench: What there is beside the robot. What no bench can see or do is not checked.

    Returns:
        Names of the checks that were done.

    Raises:
        NotConforming: At least one of them failed.
    """
    bench = bench or Bench()
    alone = _kept(BEFORE_AND_AFTER, leave_out)
    together = _kept(
        (*CONNECTED, *_at(bench, (*BENCH, *(SEEN if bench.stop_seen else ())))), leave_out
    )
    faulty = _kept(_at(bench, FAULTY if bench.fault else ()), leave_out)
    failures = dict(_alone(make_robot, alone))
    failures |= dict(_together(make_robot, together))
    failures |= dict(_alone(make_robot, faulty))
    if failures:
        raise NotConforming(failures)
    return tuple(check.__name__ for check in (*alone, *together, *faulty))


def check_names() -> tuple[str, ...]:
    """Names of all checks, in the order in which they are done."""
    checks = (*BEFORE_AND_AFTER, *CONNECTED, *BENCH, *SEEN, *FAULTY)
    return tuple(dict.fromkeys(check.__name__ for check in checks))


def _at(bench: Bench, checks: Sequence[BenchCheck]) -> list[Check]:
    """The checks with their bench, under their own names."""

    def bound(check: BenchCheck) -> Check:
        @functools.wraps(check)
        def at_the_bench(robot: Robot) -> None:
            check(robot, bench)

        return at_the_bench

    return [bound(check) for check in checks]


def _kept(checks: Sequence[Check], leave_out: Sequence[str]) -> list[Check]:
    return [check for check in checks if check.__name__ not in leave_out]


def _alone(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """Each on a robot of its own, not connected."""
    for check in checks:
        with _closing(make_robot()) as robot:
            yield from _done(check, robot)


def _together(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """One after the other on one connected robot, a new one after every failure."""
    left = list(checks)
    while left:
        with _closing(make_robot()) as robot:
            robot.connect()
            failed = False
            while left and not failed:
                for failure in _done(left.pop(0), robot):
                    failed = True
                    yield failure


def _done(check: Check, robot: Robot) -> Iterator[tuple[str, str]]:
    try:
        check(robot)
    except AssertionError as error:
        yield check.__name__, str(error)
    except Exception as error:  # a driver may fail in any way it likes
        told = error.message if isinstance(error, HilError) else str(error)
        yield check.__name__, f"raised {type(error).__name__}: {told}"


@contextlib.contextmanager
def _closing(robot: Robot) -> Iterator[Robot]:
    """However a check ended, the arm comes to rest before the next one gets a robot."""
    try:
        yield robot
    finally:
        for step in (robot.stop, lambda: settle(robot), robot.close):
            with contextlib.suppress(Exception):
                step()
