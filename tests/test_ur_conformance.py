"""The contract of a robot, kept by the UR driver over real sockets, by the unmodified `ur-rtde`.

With the driver's own options: nothing is made easier for it here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ur_mock import MockUr, mock_ur

from hil.robot import Robot
from hil.testing.bench import Bench
from hil.testing.conformance import robot_conformance
from hil_drivers.ur.options import Options
from hil_drivers.ur.robot import UrRobot

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

STOPL_RAD_S2 = 1.0
"""What 10 m/s² at the tool, its option `stop_m_s2`, are at the last joint at least."""


@contextmanager
def bench(model: str, folder: Path) -> Iterator[tuple[Callable[[], Robot], Bench]]:
    """A mock controller whose journal is the witness and whose side channel makes it fault."""
    with mock_ur("--model", model, journal=folder / "journal") as running:
        yield (
            lambda: UrRobot("arm", model, address=running.address),
            Bench(
                move_ramp_rad_s2=Options(running.address).stop_rad_s2,
                trajectory_ramp_rad_s2=STOPL_RAD_S2,
                stop_seen=lambda asked: first_stop(running, asked),
                fault=lambda robot: running.side("fault", kind="protective_stop"),
            ),
        )


def first_stop(running: MockUr, asked: float) -> float | None:
    stops = (
        float(line["monotonic_s"])
        for line in running.journal()
        if line["event"] == "stop" and line["monotonic_s"] >= asked
    )
    return next(stops, None)


@pytest.mark.parametrize("model", ["ur5", pytest.param("ur5e", marks=pytest.mark.proof)])
def test_the_driver_keeps_the_contract_of_a_robot(model: str, tmp_path: Path) -> None:
    with bench(model, tmp_path) as (make_robot, what_there_is):
        done = robot_conformance(make_robot, bench=what_there_is)
    assert {"a_stop_is_on_the_wire_in_time", "a_fault_surfaces_in_the_next_read"} <= set(done)
