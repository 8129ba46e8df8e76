"""A driver in a process of its own: started, asked, and remembered what it said of itself."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hil.core import RobotConnectionError, StructArray
from hil.robot.address import Address
from hil.robot.documents import plain_options, understood
from hil.robot.driver_process import DriverProcess
from hil.robot.facts import Facts, facts_from
from hil.robot.findings import Finding
from hil.robot.frames import Message
from hil.robot.protocol import Identity

if TYPE_CHECKING:
    from hil.robot.topic import Topic

OPEN_S = 60.0
COMMAND_S = 30.0
"""How long the driver may take to be imported, to take a command [s]."""


class HostingProcess:
    """What `hil.robot.process.RobotProcess` is made of; its arguments are described there."""

    topics: Sequence[Topic]
    drain: Callable[[], Mapping[str, StructArray]]
    resource: str
    address: Address
    checks: Callable[[], Sequence[Finding]]
    speed_scaling: float

    def __init__(
        self,
        driver: str,
        name: str,
        model: str,
        options: Mapping[str, Any] | None = None,
        *,
        gravity_m_s2: Sequence[float] | None = None,
        known: Facts | None = None,
    ) -> None:
        self._name = name
        self._how: dict[str, Any] = {
            "driver": driver,
            "name": name,
            "model": model,
            "options": plain_options(options or {}),
            "gravity": None if gravity_m_s2 is None else list(gravity_m_s2),
            "pythonpath": os.environ.get("PYTHONPATH"),
        }
        self._one_call = threading.Lock()
        self._identity: Identity | None = None
        self._process: DriverProcess | None = None
        if known is None:
            self._open()
        else:
            self._remember(known)

    @property
    def process(self) -> DriverProcess | None:
        """Where the driver lives; None once closed."""
        return self._process

    def _open(self) -> None:
        process = DriverProcess(self._name)
        try:
            self._learn(process.ask("open", OPEN_S, self._how)[0])
        except BaseException:
            process.end()
            raise
        self._process = process

    def _learn(self, document: Mapping[str, Any]) -> None:
        self._remember(facts_from(document))

    def _remember(self, facts: Facts) -> None:
        """Members that a structural check looks for exist only where the driver has them."""
        self._capabilities, self._limits = facts.capabilities, facts.limits
        self._identity = facts.identity
        if facts.topics is not None:
            self.topics, self.drain = facts.topics, self._drain
        if facts.resource is not None:
            self.resource = facts.resource
        if facts.address is not None:
            self.address = facts.address
        if facts.checks:
            self.checks = self._checks
        if facts.speed_scaling:
            self.speed_scaling = math.nan

    def _ask(self, call: str, timeout_s: float, *what: Any) -> Message:
        process = self._process
        if process is None:
            raise self._not_connected()
        with self._one_call:
            return process.ask(call, timeout_s, *what)

    def _drain(self) -> Mapping[str, StructArray]:
        said, arrays = self._ask("drain", COMMAND_S)
        with understood():
            return dict(zip(said["topics"], arrays, strict=True))

    def _checks(self) -> Sequence[Finding]:
        said, _ = self._ask("checks", COMMAND_S)
        with understood():
            return [Finding(**each) for each in said["findings"]]

    def _not_connected(self) -> RobotConnectionError:
        return RobotConnectionError(f"{self._name} is not connected", hint="call connect() first")
