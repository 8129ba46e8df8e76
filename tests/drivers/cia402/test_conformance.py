"""The contract of a robot, kept by six mock drives over CAN frames, the driver in its own process.

With the driver's own options: nothing is made easier for it here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import pytest

from hil.robot import Robot
from hil.testing.driver_conformance import Bench, robot_conformance
from hil_drivers.cia402.robot import Cia402Robot
from tests.support.cia402_robot import BusEar, options
from tests.support.mock_servers import mock_can

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]


@contextmanager
def bench(**more: object) -> Iterator[tuple[Callable[[], Robot], Bench]]:
    """Mock drives: a listener on their bus is the witness, their side channel makes them fault."""
    with mock_can() as running, closing(BusEar(running.bus())) as ear:
        yield (
            lambda: Cia402Robot("arm", "lab6", **options(running, **more)),
            Bench(
                move_ramp_rad_s2=8.0,
                trajectory_ramp_rad_s2=8.0,
                stop_seen=ear.first_after,
                fault=lambda robot: running.tell("fault", kind="emergency", axis=2, code=0x2310),
            ),
        )


def test_six_drives_keep_the_contract_of_a_robot() -> None:
    with bench() as (make_robot, what_there_is):
        done = robot_conformance(make_robot, bench=what_there_is)
    assert {"a_stop_is_on_the_wire_in_time", "a_fault_surfaces_in_the_next_read"} <= set(done)
