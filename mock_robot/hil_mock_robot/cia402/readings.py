"""What a drive measures, as raw integers in its registers."""

from __future__ import annotations

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import INT16, INT32, Axis, within, wrapped
from hil_mock_robot.cia402.contracts import Measured

DC_LINK_MV = 325_000
SAG_MV_PER_W = 10.0
"""What the DC link loses (or gains) by the power that one axis takes (or gives back)."""


def write_readings(axis: Axis, measured: Measured) -> int:
    """Write 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h to 6079h, 60F4h and 2110h.

    6077h is the current times the drive's own torque constant, as in most drives: not measured.

    Returns:
        The following error (60F4h) [increments].
    """
    objects = axis.registers
    torque = within(round(measured.torque * axis.torque_counts), INT16)
    position = axis.raw_position(measured.q)
    demand = wrapped(axis.raw_position(axis.demand_q) + axis.slipped)
    error = wrapped(demand - position)
    objects[keys.POSITION], objects[keys.POSITION_DEMAND] = position, demand
    objects[keys.FOLLOWING_ERROR] = error
    objects[keys.VELOCITY] = within(round(measured.qd * axis.speed_counts), INT32)
    objects[keys.VELOCITY_DEMAND] = within(round(axis.demand_qd * axis.speed_counts), INT32)
    objects[keys.TORQUE] = objects[keys.TORQUE_DEMAND] = torque
    objects[keys.CURRENT] = within(round(measured.current * axis.current_counts), INT16)
    objects[keys.DC_LINK_VOLTAGE] = DC_LINK_MV - round(SAG_MV_PER_W * measured.torque * measured.qd)
    objects[keys.MOTOR_TEMPERATURE] = round(10.0 * measured.celsius)
    return error
