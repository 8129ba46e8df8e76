"""The robot protocol: what drivers implement and the engine uses."""

from hil.arms.payload import Payload
from hil.robot.address import UNKNOWN, Address, HasAddress, address_of, is_loopback
from hil.robot.findings import Finding, HasChecks, HasReach
from hil.robot.protocol import (
    Capabilities,
    HasResource,
    HasSpeedScaling,
    HasTopics,
    Identity,
    Limits,
    Listens,
    Robot,
    Segment,
)
from hil.robot.state import STATE_SCHEMA_VERSION, Status, state_dtype
from hil.robot.torque import TorqueControlled, is_simulated

__all__ = [
    "STATE_SCHEMA_VERSION",
    "UNKNOWN",
    "Address",
    "Capabilities",
    "Finding",
    "HasAddress",
    "HasChecks",
    "HasReach",
    "HasResource",
    "HasSpeedScaling",
    "HasTopics",
    "Identity",
    "Limits",
    "Listens",
    "Payload",
    "Robot",
    "Segment",
    "Status",
    "TorqueControlled",
    "address_of",
    "is_loopback",
    "is_simulated",
    "state_dtype",
]
