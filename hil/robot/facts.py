"""What is known of a robot besides its state, as JSON for the line to its driver's process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.robot.address import Address, HasAddress
from hil.robot.documents import understood
from hil.robot.findings import HasChecks
from hil.robot.frames import dtype_of, dtype_text
from hil.robot.protocol import (
    Capabilities,
    HasResource,
    HasSpeedScaling,
    HasTopics,
    Identity,
    Limits,
    Robot,
)
from hil.robot.topic import Topic

if TYPE_CHECKING:
    from hil.robot.topic import Topic

_ARRAYS = ("q_min", "q_max", "qd_max", "qdd_max", "effort_max")


@dataclass(frozen=True, slots=True)
class Facts:
    """What a driver says about its robot.

    Attributes:
        capabilities, limits: Known before and after connecting.
        topics, resource, address: None when the driver does not opt into them.
        identity: None before connecting.
        checks: Whether it looks at itself before it moves.
        speed_scaling: Whether it reports how much slower than commanded it moves.
    """

    capabilities: Capabilities
    limits: Limits
    topics: tuple[Topic, ...] | None
    resource: str | None
    identity: Identity | None
    checks: bool
    address: Address | None = None
    speed_scaling: bool = False


def facts_document(robot: Robot, *, connected: bool) -> dict[str, Any]:
    """The facts of a robot, ready for JSON."""
    limits = robot.limits
    return {
        "capabilities": asdict(robot.capabilities),
        "limits": {name: getattr(limits, name).tolist() for name in _ARRAYS}
        | {"payload_max_kg": limits.payload_max_kg},
        "topics": [_topic_document(t) for t in robot.topics]
        if isinstance(robot, HasTopics)
        else None,
        "resource": robot.resource if isinstance(robot, HasResource) else None,
        "identity": asdict(robot.identity) if connected else None,
        "checks": isinstance(robot, HasChecks),
        "address": asdict(robot.address) if isinstance(robot, HasAddress) else None,
        "speed_scaling": isinstance(robot, HasSpeedScaling),
    }


def facts_from(document: Mapping[str, Any]) -> Facts:
    """The other half of `facts_document`.

    Raises:
        RobotConnectionError: It is no such document.
    """
    with understood():
        topics, identity = document["topics"], document["identity"]
        address = document["address"]
        return Facts(
            capabilities=_capabilities_from(document["capabilities"]),
            limits=_limits_from(document["limits"]),
            topics=None if topics is None else _topics_from(topics),
            resource=document["resource"],
            identity=None if identity is None else Identity(**identity),
            checks=bool(document["checks"]),
            address=None if address is None else Address(**address),
            speed_scaling=bool(document["speed_scaling"]),
        )


def _capabilities_from(document: Mapping[str, Any]) -> Capabilities:
    tuples = {name: tuple(document[name]) for name in ("joint_names", "drive_gains")}
    return Capabilities(**{**document, **tuples})


def _limits_from(document: Mapping[str, Any]) -> Limits:
    arrays = {name: np.array(document[name], dtype=np.float64) for name in _ARRAYS}
    return Limits(**arrays, payload_max_kg=float(document["payload_max_kg"]))


def _topics_from(documents: Sequence[Mapping[str, Any]]) -> tuple[Topic, ...]:
    return tuple(Topic(**{**each, "dtype": dtype_of(each["dtype"])}) for each in documents)


def _topic_document(topic: Topic) -> dict[str, Any]:
    return {
        "name": topic.name,
        "dtype": dtype_text(topic.dtype),
        "rate_hz": topic.rate_hz,
        "clock": topic.clock,
        "units": dict(topic.units),
        "schema_name": topic.schema_name,
        "schema_version": topic.schema_version,
    }
