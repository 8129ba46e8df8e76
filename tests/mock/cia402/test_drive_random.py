"""Whatever a master does, and whatever happens beside it, a mock drive keeps some promises."""

import math

import numpy as np
import pytest

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import COASTING_STEPS, POWERED, State
from tests.support.can_drive_parts import OneDrive

WORDS = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x0F, 0x1F, 0x3F, 0x5F, 0x80, 0x86, 0x10F, 0x11F)
SETTINGS = (
    (keys.MODE, (0, 1, 3, 6, 8, 9, 10)),
    (keys.QUICK_STOP_OPTION, range(9)),
    (keys.SHUTDOWN_OPTION, (0, 1)),
    (keys.DISABLE_OPTION, (0, 1)),
    (keys.FAULT_REACTION_OPTION, range(5)),
    (keys.ABORT_CONNECTION_OPTION, range(4)),
    (keys.INTERPOLATION_VALUE, range(1, 12)),
    (keys.HOMING_METHOD, (0, 35, 37)),
)


def upset(one, rng):
    """Something that a master may do, or that may happen."""
    dice = rng.integers(12)
    counts = one.counts
    if dice < 4:
        one.registers[keys.CONTROLWORD] = int(rng.choice(WORDS))
    elif dice < 7:
        where, values = SETTINGS[rng.integers(len(SETTINGS))]
        one.set(where, int(rng.choice(values)))
    elif dice < 9:
        near = one.registers[keys.POSITION] + int(rng.normal() * 0.01 * counts)
        one.registers[keys.TARGET_POSITION] = near
        one.registers[keys.TARGET_VELOCITY] = int(rng.normal() * 0.5 * counts)
        one.registers[keys.TARGET_TORQUE] = int(rng.normal() * 50)
    else:
        happens = (
            lambda: one.drive.fault(0xFF01),
            lambda: one.drive.connection.lost(0x8130),
            one.drive.connection.taken_off,
            one.drive.restart,
            one.drive.slip,
            one.drive.reset,
            lambda: setattr(one.drive.operation, "deaf", bool(rng.integers(2))),
            lambda: None,
            lambda: None,
        )
        happens[rng.integers(len(happens))]()


@pytest.mark.parametrize("seed", range(40))
def test_current_flows_only_with_power_and_the_brake_comes_after_it(seed):
    rng = np.random.default_rng(seed)
    one, unpowered = OneDrive().on(), 0
    for _ in range(250):
        if rng.random() < 0.7:
            upset(one, rng)
        steps = int(rng.integers(1, 12))
        demand = one.cycles(1, synced=bool(rng.random() < 0.8), steps=steps)
        unpowered = 0 if one.state in POWERED else unpowered + steps
        assert np.isfinite(demand.setpoints).all()
        if demand.braked:
            assert math.isnan(demand.torque)
        elif one.state not in POWERED and unpowered > steps:
            assert demand.torque == 0.0
        if unpowered > COASTING_STEPS + 2 * 12:
            assert demand.braked
            assert one.qd == 0.0
        assert one.registers[keys.STATUSWORD] & 0x4F == one.state.value & 0x4F


@pytest.mark.parametrize("seed", range(20))
def test_any_drive_can_be_enabled_again(seed):
    rng = np.random.default_rng(seed)
    one = OneDrive().on()
    for _ in range(100):
        upset(one, rng)
        one.cycles(1)
    one.drive.operation.deaf = False
    one.set(keys.QUICK_STOP_OPTION, 2)
    one.set(keys.MODE, 8)
    one.tell(0x00, cycles=500)
    one.tell(0x80)
    assert one.state is State.SWITCH_ON_DISABLED
    one.set(keys.TARGET_POSITION, one.registers[keys.POSITION])
    one.set(keys.POSITION_OFFSET, 0)
    for word in (0x06, 0x07, 0x0F):
        one.tell(word)
    assert one.state is State.OPERATION_ENABLED
