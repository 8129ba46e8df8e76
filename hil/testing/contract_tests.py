"""Driver conformance checks as a pytest class with one test per check.

>>> from hil.testing import RobotConformance
>>> class TestMyArm(RobotConformance):
...     @pytest.fixture
...     def make_robot(self):
...         return lambda: MyArm("bench", "ur5", address="192.0.2.7")
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pytest

from hil.testing.driver_conformance import (
    Bench,
    MakeRobot,
    NotConforming,
    check_names,
    robot_conformance,
)


class RobotConformance:
    """Base class of the conformance tests of a driver.

    A derived class has a name `Test…`, a fixture `make_robot`, and a fixture `bench` if the driver
    has a test bench.

    Attributes:
        leave_out: Names of conformance checks that are skipped.
    """

    leave_out: ClassVar[Sequence[str]] = ()

    @pytest.fixture
    def make_robot(self) -> MakeRobot:
        """Return a function that creates a new robot object, not connected."""
        return pytest.fail(
            f"{type(self).__name__} lacks the fixture make_robot, which returns a function that "
            "creates a robot that is not connected",
            pytrace=False,
        )

    @pytest.fixture
    def bench(self) -> Bench:
        """Return the test bench of the robot under test."""
        return Bench()

    @pytest.mark.parametrize("check", check_names())
    def test_contract(self, check: str, make_robot: MakeRobot, bench: Bench) -> None:
        """Run one of the checks of `robot_conformance`."""
        if check in self.leave_out:
            pytest.skip("left out")
        others = [name for name in check_names() if name != check]
        try:
            done = robot_conformance(make_robot, leave_out=others, bench=bench)
        except NotConforming as error:
            pytest.fail(str(error).strip(), pytrace=False)
        if not done:
            pytest.skip("the bench cannot observe or cause the condition of this check")
