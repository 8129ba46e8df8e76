"""What other people's pytest gets from hil: mock robots as fixtures, and nothing unasked."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.core import plugins
from hil.core.errors import RobotFault, RobotTimeout, SpecError
from hil.robot import Robot, Status
from hil.testing.contract_tests import RobotConformance
from hil.testing.driver_conformance import Conformance, MakeRobot, check_names
from hil.testing.mocks import MockRobot
from tests.support.kinematic_robot import KinematicRobot


def pytest_of_others(folder: Path, test: str, *options: str) -> str:
    """What pytest says about somebody's test file; as strict as one can be."""
    (folder / "test_theirs.py").write_text(test, "utf-8")
    own = ["-p", "no:cacheprovider", "--strict-markers", "--strict-config", "-rA"]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pytest", *own, *options, "test_theirs.py"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    return done.stdout + done.stderr


def read_on(robot: Robot) -> None:
    """About a second of device time."""
    for _ in range(10):
        robot.read()


def test_the_robot_is_connected(mock_robot: MockRobot) -> None:
    assert isinstance(mock_robot, Robot)
    assert mock_robot.identity.model == "ur5"
    assert len(mock_robot.read())


@pytest.mark.mock_robot("ur10e", seed=3, profile="ideal")
def test_a_marker_says_which_robot(mock_robot: MockRobot) -> None:
    assert mock_robot.identity.model == "ur10e"
    assert mock_robot.identity.serial.endswith("ideal-3")


def test_a_factory_gives_as_many_as_are_asked_for(
    mock_robot_factory: Callable[..., MockRobot],
) -> None:
    robots = [mock_robot_factory(seed=seed, name=f"arm{seed}") for seed in (1, 2)]
    assert {robot.identity.serial for robot in robots} == {"arm1-full-1", "arm2-full-2"}


def test_a_fault_lasts_as_long_as_the_with(mock_robot: MockRobot) -> None:
    with mock_robot.fault("silence"), pytest.raises(RobotTimeout):
        mock_robot.read(0.1)
    assert len(mock_robot.read(0.1))


def test_a_fault_may_come_later(mock_robot: MockRobot) -> None:
    now = mock_robot.read()[-1]["device_time"]
    mock_robot.fault("protective_stop", at_s=now + 0.1)
    assert not mock_robot.read()[0]["status"] & Status.FAULT
    with pytest.raises(RobotFault, match="protective stop"):
        read_on(mock_robot)
    mock_robot.connect()
    assert len(mock_robot.read())


def test_what_was_to_come_is_forgotten(mock_robot: MockRobot) -> None:
    with mock_robot.fault("cut", at_s=0.2):
        pass
    read_on(mock_robot)


def test_a_fault_that_cannot_be_is_refused(mock_robot: MockRobot) -> None:
    with pytest.raises(SpecError, match="protective_stop"):
        mock_robot.fault("protectivestop")


@pytest.mark.parametrize(
    ("fixture", "missing", "extras"),
    [
        ("mock_robot_factory", "numba", "mock"),
        ("ur_controller_factory", "mujoco", "mock"),
        ("can_bus_factory", "canopen", "can,mock"),
    ],
)
def test_a_missing_extra_is_one_clear_failure(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    fixture: str,
    missing: str,
    extras: str,
) -> None:
    make = request.getfixturevalue(fixture)
    there = plugins.find_spec
    monkeypatch.setattr(plugins, "find_spec", lambda name: None if name == missing else there(name))
    with pytest.raises(pytest.fail.Exception) as caught:
        make()
    assert f"needs {missing}" in str(caught.value)
    assert f'pip install "hil[{extras}]"' in str(caught.value)


class TestAnArmThatConforms(RobotConformance):
    @pytest.fixture
    def make_robot(self) -> MakeRobot:
        return KinematicRobot


def test_the_checks_as_one_test(robot_conformance: Conformance) -> None:
    name = "a_robot_at_rest_holds"
    others = [each for each in check_names() if each != name]
    assert robot_conformance(KinematicRobot, leave_out=others) == (name,)


BROKEN = """
import pytest
from tests.support.kinematic_robot import KinematicRobot
from hil.testing.contract_tests import RobotConformance


class Forgets(KinematicRobot):
    def set_payload(self, payload):
        return type(payload)()


class TestForgets(RobotConformance):
    leave_out = ["a_robot_at_rest_holds"]

    @pytest.fixture
    def make_robot(self):
        return Forgets
"""


@pytest.mark.thorough
def test_each_check_is_a_test_of_its_own(tmp_path: Path) -> None:
    said = pytest_of_others(tmp_path, BROKEN)
    assert f"1 failed, {len(check_names()) - 4} passed, 3 skipped" in said
    assert "FAILED test_theirs.py::TestForgets::test_contract[the_payload_is_read_back]" in said
    assert "Traceback" not in said


FIVE_LINES = """
import pytest

@pytest.mark.mock_robot("ur5e")
def test_it(mock_robot):
    assert mock_robot.read()["effort"].shape[1] == 6
"""


@pytest.mark.thorough
def test_five_lines_are_enough(tmp_path: Path) -> None:
    assert "1 passed" in pytest_of_others(tmp_path, FIVE_LINES)


LIGHT = """
import sys

def test_it():
    named = [name for name in sys.modules if name.split(".")[0] in ("hil", "hil_mock_robot")]
    assert sorted(named) == ["hil", "hil.testing", "hil.testing.plugin"]
    assert not {"numpy", "mujoco", "numba", "can", "scipy"} & set(sys.modules)
"""


@pytest.mark.thorough
def test_who_uses_nothing_loads_nothing(tmp_path: Path) -> None:
    said = pytest_of_others(tmp_path, LIGHT)
    assert "1 passed" in said, said


@pytest.mark.thorough
def test_it_can_be_switched_off(tmp_path: Path) -> None:
    harmless = "def test_it(): pass"
    assert "1 passed" in pytest_of_others(tmp_path, harmless, "-p", "no:hil")
    said = pytest_of_others(tmp_path, FIVE_LINES.replace("@", "#"), "-p", "no:hil")
    assert "fixture 'mock_robot' not found" in said
