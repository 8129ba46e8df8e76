"""The contract of a robot as a class of tests, one for each check.

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
    """Derive a class named `Test…` and give it a fixture `make_robot`, and `bench` if you have one.

    Attributes:
        leave_out: Checks that are skipped.
    """

    leave_out: ClassVar[Sequence[str]] = ()

    @pytest.fixture
    def make_robot(self) -> MakeRobot:
        """Gives a robot that is not connected, a fresh one each time."""
        return pytest.fail(
            f"{type(self).__name__} has no fixture make_robot: one that returns a function that "
            "makes your robot, not connected",
            pytrace=False,
        )

    @pytest.fixture
    def bench(self) -> Bench:
        """What there is beside the robot."""
        return Bench()

    @pytest.mark.parametrize("check", check_names())
    def test_contract(self, check: str, make_robot: MakeRobot, bench: Bench) -> None:
        """One check of `robot_conformance`."""
        if check in self.leave_out:
            pytest.skip("left out")
        others = [name for name in check_names() if name != check]
        try:
            done = robot_conformance(make_robot, leave_out=others, bench=bench)
        except NotConforming as error:
            pytest.fail(str(error).strip(), pytrace=False)
        if not done:
            pytest.skip("the bench can neither see nor do what it takes")
