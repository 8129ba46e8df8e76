"""The contract of a robot, kept by the UR driver over real sockets, by the unmodified `ur-rtde`.

With the driver's own options: nothing is made easier for it here.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hil.testing.driver_conformance import Bench, Conformance
from hil.testing.mocks import UrController
from hil_drivers.ur.options import Options
from hil_drivers.ur.robot import UrRobot

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

STOPL_RAD_S2 = 1.0
"""What 10 m/s² at the tool, its option `stop_m_s2`, are at the last joint at least."""


def bench_of(running: UrController) -> Bench:
    """A mock controller whose journal is the witness and whose side channel makes it fault."""
    return Bench(
        move_ramp_rad_s2=Options(running.host).stop_rad_s2,
        trajectory_ramp_rad_s2=STOPL_RAD_S2,
        stop_seen=lambda asked: first_stop(running, asked),
        fault=lambda robot: running.fault("protective_stop"),
    )


def first_stop(running: UrController, asked: float) -> float | None:
    stops = (float(line["monotonic_s"]) for line in running.journal("stop"))
    return next((at for at in stops if at >= asked), None)


@pytest.mark.parametrize("model", ["ur5", pytest.param("ur5e", marks=pytest.mark.proof)])
def test_the_driver_keeps_the_contract_of_a_robot(
    model: str,
    ur_controller_factory: Callable[..., UrController],
    robot_conformance: Conformance,
) -> None:
    running = ur_controller_factory(model, seed=1)
    done = robot_conformance(
        lambda: UrRobot("arm", model, address=running.host), bench=bench_of(running)
    )
    assert {"a_stop_is_on_the_wire_in_time", "a_fault_surfaces_in_the_next_read"} <= set(done)
