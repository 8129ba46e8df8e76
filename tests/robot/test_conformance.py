"""Every robot keeps the contract of `hil.robot.Robot`, and the checks find one that does not."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
import pytest

from hil.core.errors import CommandRefused, RobotFault
from hil.core.typing import StructArray
from hil.robot import Capabilities, Limits, Robot, Segment, Status
from hil.robot.subprocess_robot import RobotProcess
from hil.testing.driver_conformance import (
    BEFORE_AND_AFTER,
    BENCH,
    CONNECTED,
    FAULTY,
    SEEN,
    Bench,
    NotConforming,
    a_fault_surfaces_in_the_next_read,
    robot_conformance,
    rows_are_in_the_units_they_say,
)
from hil_drivers.cia402.robot import Cia402Robot
from hil_drivers.twincat.robot import TwinCatRobot
from hil_drivers.ur.options import Options
from hil_drivers.ur.robot import UrRobot
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.cia402_robot import BusEar, options
from tests.support.kinematic_robot import KinematicRobot
from tests.support.mock_servers import mock_can, mock_plc, mock_ur

Place: TypeAlias = tuple[Callable[[], Robot], Bench]
"""Makes the robot, and what there is beside it."""


@contextmanager
def kinematic() -> Iterator[Place]:
    yield KinematicRobot, Bench()


@contextmanager
def embedded() -> Iterator[Place]:
    """A push that is too strong makes it fault."""

    def push(robot: Robot) -> None:
        assert isinstance(robot, MockRobot)
        robot.push([200.0, 0, 0, 0, 0, 0])

    yield lambda: MockRobot("bench", "ur5"), Bench(fault=push)


@contextmanager
def embedded_in_wall_time() -> Iterator[Place]:
    yield lambda: MockRobot("bench", "ur5", clock="wall"), Bench()


def in_its_own_process(driver: str, model: str, options: dict[str, Any] | None = None) -> Any:
    @contextmanager
    def place() -> Iterator[Place]:
        yield lambda: RobotProcess(driver, "bench", model, options or {}), Bench()

    return place


def ur(model: str) -> Any:
    """A mock controller whose journal is the witness and whose side channel makes it fault."""

    @contextmanager
    def place() -> Iterator[Place]:
        with TemporaryDirectory() as folder:
            journal = Path(folder, "journal")
            with mock_ur("--model", model, journal=journal) as running:
                yield (
                    lambda: UrRobot("arm", model, address=running.address),
                    Bench(
                        move_ramp_rad_s2=Options(running.address).stop_rad_s2,
                        trajectory_ramp_rad_s2=STOPL_RAD_S2,
                        stop_seen=lambda asked: first_stop(running.journal("stop"), asked),
                        fault=lambda robot: running.side("fault", kind="protective_stop"),
                    ),
                )

    return place


STOPL_RAD_S2 = 1.0
"""What 10 m/s² at the tool, its option `stop_m_s2`, are at the last joint at least."""


@contextmanager
def cia402() -> Iterator[Place]:
    """Mock drives: a listener on their bus is the witness, their side channel makes them fault."""
    with mock_can() as running, closing(BusEar(running.bus())) as ear:
        yield (
            lambda: Cia402Robot("arm", "lab6", **options(running)),
            Bench(
                move_ramp_rad_s2=8.0,
                trajectory_ramp_rad_s2=8.0,
                stop_seen=ear.first_after,
                fault=lambda robot: running.tell("fault", kind="emergency", axis=2, code=0x2310),
            ),
        )


@contextmanager
def twincat() -> Iterator[Place]:
    """A mock PLC whose journal is the witness and whose side channel makes it fault."""
    with TemporaryDirectory() as folder, mock_plc(Path(folder), "--speed", "3") as running:
        yield (
            lambda: TwinCatRobot("arm", "lab6", address=running.address),
            Bench(
                move_ramp_rad_s2=8.0,
                trajectory_ramp_rad_s2=8.0,
                stop_seen=lambda asked: first_stop(running.journal("stop"), asked),
                fault=lambda robot: running.side(kind="drive_fault"),
            ),
        )


def first_stop(stops: Sequence[Mapping[str, Any]], asked: float) -> float | None:
    """The first stop in a journal since a moment of `time.monotonic`."""
    return next((at for line in stops if (at := float(line["monotonic_s"])) >= asked), None)


UNREACHABLE = ("a_robot_in_wall_time_says_which_one_it_is",)
"""Nobody outside its process can reach an embedded mock in wall time."""

WIRE, PROOF = pytest.mark.wire, (pytest.mark.wire, pytest.mark.proof)
ROBOTS = {
    "kinematic robot": ("", kinematic, (), pytest.mark.thorough),
    "embedded mock": ("mock", embedded, (), pytest.mark.thorough),
    "kinematic robot in its own process": (
        "",
        in_its_own_process("tests.support.process_drivers:Kinematic", "ur5"),
        (),
        pytest.mark.thorough,
    ),
    "embedded mock in wall time": ("mock", embedded_in_wall_time, UNREACHABLE, PROOF),
    "embedded mock in wall time in its own process": (
        "mock",
        in_its_own_process("mock", "lab6", {"clock": "wall"}),
        UNREACHABLE,
        WIRE,
    ),
    "other arm in its own process": (
        "",
        in_its_own_process("tests.support.process_drivers:WallArm", "ur5"),
        (),
        PROOF,
    ),
    "UR5 over RTDE": ("ur", ur("ur5"), (), WIRE),
    "UR5e over RTDE": ("ur", ur("ur5e"), (), PROOF),
    "CiA 402 drives over CAN": ("cia402", cia402, (), WIRE),
    "PLC over ADS": ("twincat", twincat, (), WIRE),
}
"""Robot → driver, where it is tested, what is left out there, tier.

Drivers have their own options: nothing is made easier for them here.
"""


@pytest.mark.timeout(240)
@pytest.mark.parametrize(
    ("place", "leave_out"),
    [pytest.param(*each[1:3], marks=each[3], id=name) for name, each in ROBOTS.items()],
)
def test_a_robot_keeps_the_contract(
    place: Callable[[], AbstractContextManager[Place]], leave_out: Sequence[str]
) -> None:
    with place() as (make_robot, bench):
        done = robot_conformance(make_robot, leave_out=leave_out, bench=bench)
    asked = (*SEEN * bool(bench.stop_seen), *FAULTY * bool(bench.fault))
    wanted = (*BEFORE_AND_AFTER, *CONNECTED, *BENCH, *asked)
    assert sorted((*done, *leave_out)) == sorted(check.__name__ for check in wanted)


def test_every_driver_is_held_to_the_contract() -> None:
    assert {entry.name for entry in entry_points(group="hil.drivers")} <= {
        driver for driver, *_ in ROBOTS.values()
    }


class SlowToStop(KinematicRobot):
    def stop(self) -> None:
        time.sleep(0.12)
        super().stop()


class StopsNothing(KinematicRobot):
    def stop(self) -> None:
        return


class AsksForConnect(KinematicRobot):
    """Its stops out of a motion leave it in need of `connect`, as often as it is said here."""

    times = 1_000

    def stop(self) -> None:
        moving = (
            self.connected and not self.asks and bool(self.read()[-1]["status"] & Status.MOVING)
        )
        super().stop()
        if moving and self.times:
            self.times, self.asks = self.times - 1, True

    asks = False

    def connect(self) -> None:
        super().connect()
        self.asks = False

    def prepare(self, segment: Segment) -> None:
        if self.asks:
            raise RobotFault("stopped another way", hint="connect() again")
        super().prepare(segment)


class AsksForConnectOnce(AsksForConnect):
    times = 1


class NamesNoSegment(KinematicRobot):
    def read(self, timeout_s: float = 1.0) -> StructArray:
        block = super().read(timeout_s)
        block["segment"] = -1
        return block


class RepeatsItself(KinematicRobot):
    def read(self, timeout_s: float = 1.0) -> StructArray:
        block = super().read(timeout_s)
        block["device_time"][1] = block["device_time"][0]
        return block


class GoesElsewhere(KinematicRobot):
    def prepare(self, segment: Segment) -> None:
        super().prepare(replace(segment, q=segment.q + 0.05))


class ClosesBadly(KinematicRobot):
    def close(self) -> None:
        if not self.connected:
            raise OSError("closed already")
        super().close()


class TalksAfterClosing(KinematicRobot):
    def close(self) -> None:
        return


class ForgetsThePayload(KinematicRobot):
    def set_payload(self, payload: Any) -> Any:
        return type(payload)()


class KnowsNoLimit(KinematicRobot):
    @property
    def limits(self) -> Limits:
        return replace(super().limits, effort_max=np.array([10.0, 10, 10, 10, 10, np.inf]))


class InWallTime(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, clock="wall")


class NamesNoAddress(InWallTime):
    resource = " "


class LacksGains(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, drive_gains=(8.0, 8.0, 8.0, 8.0, 8.0, 0.0))


class BrakesSlowly(KinematicRobot):
    """Comes to rest in a second."""

    def stop(self) -> None:
        left = self._queue[:1] * 60
        self._queue = [(q, qd * 0.5) for q, qd in left]


class TakesAnything(KinematicRobot):
    def prepare(self, segment: Segment) -> None:
        self._prepared = segment


class TakesOneFieldFor(KinematicRobot):
    """Gives one field in another unit, or late."""

    def __init__(self, change: Callable[[StructArray], None]) -> None:
        super().__init__(change)

    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, drive_gains=(8.0,) * 6)


def scaled(field: str, factor: float) -> Callable[[StructArray], None]:
    def change(block: StructArray) -> None:
        block[field] *= factor

    return change


def milliamperes(block: StructArray) -> None:
    block["effort"] = 800.0


def kelvin(block: StructArray) -> None:
    block["temperature"] += 273.15


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (scaled("q", 57.3), "q is"),
        (scaled("qd", 57.3), "in rad/s"),
        (scaled("qd", -1.0), "in rad/s"),
        (scaled("device_time", 0.5), "in rad/s"),
        (milliamperes, "effort of j1"),
        (kelvin, "in °C"),
    ],
)
def test_a_unit_that_is_another_is_found(change: Callable[[StructArray], None], told: str) -> None:
    robot = TakesOneFieldFor(change)
    robot.connect()
    with pytest.raises(AssertionError, match=told):
        rows_are_in_the_units_they_say(robot)


def test_rows_at_another_rate_are_found() -> None:
    robot = KinematicRobot(both(scaled("device_time", 1.05), scaled("qd", 1 / 1.05)))
    robot.connect()
    with pytest.raises(AssertionError, match=r"measured rate 119 Hz"):
        rows_are_in_the_units_they_say(robot)


def both(*changes: Callable[[StructArray], None]) -> Callable[[StructArray], None]:
    def change(block: StructArray) -> None:
        for each in changes:
            each(block)

    return change


@pytest.mark.wire
def test_a_fault_of_the_mock_in_its_own_process_surfaces_in_the_next_read() -> None:
    faults = [{"kind": "protective_stop", "at_s": 1.0}]
    robot = RobotProcess("mock", "bench", "ur5", {"clock": "wall", "faults": faults})

    def waits(robot: Robot) -> None:
        """It comes by itself."""

    try:
        a_fault_surfaces_in_the_next_read(robot, Bench(fault=waits))
    finally:
        robot.close()


class FaultsIn(KinematicRobot):
    """Shows a fault when it is asked for one, and raises so many reads later."""

    def __init__(self, reads: int = 1, obeys: bool = False) -> None:
        super().__init__()
        self.faulty, self._left, self._obeys = False, reads, obeys

    def read(self, timeout_s: float = 1.0) -> StructArray:
        if self.faulty and self._left <= 0:
            raise RobotFault("it has faulted")
        block = super().read(timeout_s)
        if self.faulty:
            self._left -= 1
            block["status"] |= int(Status.FAULT)
        return block

    def prepare(self, segment: Segment) -> None:
        if self.faulty and not self._obeys:
            raise CommandRefused("it has faulted")
        super().prepare(segment)


def strike(robot: Robot) -> None:
    assert isinstance(robot, FaultsIn)
    robot.faulty = True


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        (lambda: FaultsIn(2), "the next read did not raise it"),
        (lambda: FaultsIn(1, obeys=True), "prepare after a fault"),
    ],
)
def test_a_fault_that_is_told_late_or_not_minded_is_found(
    robot: Callable[[], Robot], told: str
) -> None:
    with pytest.raises(AssertionError, match=told):
        a_fault_surfaces_in_the_next_read(robot(), Bench(fault=strike))


def test_a_fault_that_is_never_told_is_found() -> None:
    with pytest.raises(AssertionError, match="no read has raised the fault"):
        a_fault_surfaces_in_the_next_read(KinematicRobot(), Bench(fault=lambda robot: None))


def test_a_fault_that_is_told_is_what_is_asked_for() -> None:
    a_fault_surfaces_in_the_next_read(FaultsIn(), Bench(fault=strike))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("seen", "told"),
    [
        (lambda asked: asked + 0.2, "on the wire after 200 ms"),
        (lambda asked: None, "no stop reached the controller"),
    ],
)
def test_a_stop_that_comes_late_or_never_is_found(
    seen: Callable[[float], float | None], told: str
) -> None:
    with pytest.raises(NotConforming, match=told) as caught:
        robot_conformance(KinematicRobot, bench=Bench(stop_seen=seen))
    assert list(caught.value.failures) == ["a_stop_is_on_the_wire_in_time"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("robot", "check"),
    [
        (BrakesSlowly, "stop_ends_a_move"),
        (BrakesSlowly, "stop_ends_a_trajectory"),
        (TakesAnything, "a_position_beyond_the_limits_is_refused"),
        (TakesAnything, "a_velocity_beyond_the_limits_is_refused"),
        (TakesAnything, "an_acceleration_beyond_the_limits_is_refused"),
        (KnowsNoLimit, "every_joint_has_limits_and_gains"),
        (InWallTime, "a_robot_in_wall_time_says_which_one_it_is"),
        (NamesNoAddress, "a_robot_in_wall_time_says_which_one_it_is"),
        (LacksGains, "every_joint_has_limits_and_gains"),
        (SlowToStop, "stop_works_before_connecting"),
        (SlowToStop, "stop_works_at_rest_and_again"),
        (StopsNothing, "stop_ends_a_move"),
        (AsksForConnect, "stop_ends_a_move"),
        (AsksForConnect, "stop_ends_a_trajectory"),
        (NamesNoSegment, "a_move_ends_where_it_was_told"),
        (RepeatsItself, "rows_are_state_rows_in_order"),
        (GoesElsewhere, "a_move_ends_where_it_was_told"),
        (ClosesBadly, "a_closed_robot_is_gone"),
        (TalksAfterClosing, "a_closed_robot_is_gone"),
        (ForgetsThePayload, "the_payload_is_read_back"),
    ],
)
def test_a_robot_that_breaks_the_contract_is_found(robot: type[KinematicRobot], check: str) -> None:
    with pytest.raises(NotConforming) as caught:
        robot_conformance(robot)
    assert check in caught.value.failures


def test_one_stop_that_had_to_be_made_another_way_is_no_breach() -> None:
    kept = [check.__name__ for check in (*BEFORE_AND_AFTER, *CONNECTED, *BENCH)]
    others = [name for name in kept if name != "stop_ends_a_move"]
    assert robot_conformance(AsksForConnectOnce, leave_out=others) == ("stop_ends_a_move",)


def test_a_check_can_be_left_out() -> None:
    done = robot_conformance(ForgetsThePayload, leave_out=["the_payload_is_read_back"])
    assert "the_payload_is_read_back" not in done


@pytest.mark.thorough
def test_the_checks_need_no_pytest() -> None:
    code = "import sys, hil.testing.driver_conformance; assert 'pytest' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
