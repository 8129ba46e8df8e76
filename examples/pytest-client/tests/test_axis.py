"""The axis against mock drives: same CANopen stack, same objects, same states."""

import canopen
import pytest
from cell_client.axis import Axis, DriveFault

FAR = 5_000_000
"""Increments: nearly five turns of the motor."""
CLOSE = 10_000


@pytest.fixture
def axis(can_bus):
    network = canopen.Network()
    network.connect(**can_bus.config)
    axis = Axis(network, 6)
    axis.enable()
    yield axis
    network.disconnect()


def test_the_axis_gets_where_it_was_told(axis):
    start = axis.position()
    axis.move(start + FAR)
    assert axis.position() == pytest.approx(start + FAR, abs=CLOSE)


def test_it_goes_on_after_a_following_error(axis, can_bus):
    start = axis.position()
    soon = can_bus.state()["device_time"] + 0.3
    can_bus.fault("following_error", axis=6, at_s=soon)
    with pytest.raises(DriveFault, match="8611h"):
        axis.move(start + FAR)
    axis.enable()
    axis.move(start)
    assert axis.position() == pytest.approx(start, abs=CLOSE)
