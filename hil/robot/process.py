"""A robot whose driver lives in a process of its own: it may hang or die, and the arm is stopped.

Decision record 0014 says why, what happens when either side goes, and what a call costs.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.errors import CommandRefused, HilError, RobotConnectionError
from hil.payload import Payload
from hil.robot.documents import payload_from, plain_options, segment_document, understood
from hil.robot.driver_process import DriverProcess
from hil.robot.facts import Facts, facts_from
from hil.robot.findings import Finding
from hil.robot.frames import Message, garbage
from hil.robot.protocol import Capabilities, Identity, Limits, Segment
from hil.typing import StructArray

if TYPE_CHECKING:
    from hil.record.topic import Topic

OPEN_S = 60.0
CONNECT_S = 120.0
COMMAND_S = 30.0
CLOSE_S = 3.0
"""How long the driver may take to be imported, to connect, to take a command, to close [s]."""

READ_GRACE_S = {"wall": 1.0, "virtual": 10.0}
"""How much longer than its own time-out a read may take; a virtual clock may be slow [s]."""


class RobotProcess:
    """Implements `hil.robot.Robot` by a driver in a child process; Linux only.

    `stop` works while another thread waits in any other member, and from a signal handler. A
    closed robot can be connected again, in a new process. What the driver opts into (`topics` and
    `drain`, `resource`, `checks`) this robot has too, and else it has not.

    Args:
        driver: Name under `hil.drivers`, or `module:Class`.
        name: The robot's name in its station.
        model: A built-in arm, or a path.
        options: The driver's own; what YAML can hold.
        gravity_m_s2: For drivers that simulate: gravity in the base frame.
        known: What the driver would say before it is connected; its process is started by
            `connect` then, not now.

    Raises:
        PluginError: There is no such driver, it does not load, or the system is not Linux.
        SpecError: The driver does not accept its options.
        RobotError: Its process does not come up.
    """

    topics: Sequence[Topic]
    drain: Callable[[], Mapping[str, StructArray]]
    resource: str
    checks: Callable[[], Sequence[Finding]]

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
        self._last_stop = object()  # a new one with every stop: told apart without a lock
        if known is None:
            self._open()
        else:
            self._remember(known)

    @property
    def process(self) -> DriverProcess | None:
        """Where the driver lives; None once closed."""
        return self._process

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        if self._identity is None:
            raise self._not_connected()
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return self._capabilities

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`."""
        return self._limits

    def connect(self) -> None:
        """See `hil.robot.Robot`; refused when `stop` comes meanwhile, and closed then."""
        stop = self._last_stop
        if self._process is not None and not self._process.alive:
            self.close()
        if self._process is None:
            self._open()
        self._refuse_if_stopped_since(stop)
        self._learn(self._ask("connect", CONNECT_S)[0])
        self._refuse_if_stopped_since(stop)

    def set_payload(self, payload: Payload) -> Payload:
        """See `hil.robot.Robot`."""
        said, _ = self._ask("set_payload", COMMAND_S, asdict(payload))
        with understood():
            return payload_from(said["payload"])

    def prepare(self, segment: Segment) -> None:
        """See `hil.robot.Robot`."""
        self._ask("prepare", COMMAND_S, *segment_document(segment))

    def start(self) -> None:
        """See `hil.robot.Robot`."""
        self._ask("start", COMMAND_S)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """See `hil.robot.Robot`; `RobotTimeout` also when the driver hangs.

        Rows that came too late for the read that asked for them come with the next one.
        """
        patience_s = timeout_s + READ_GRACE_S[self._capabilities.clock]
        _, arrays = self._ask("read", patience_s, {"timeout_s": timeout_s})
        if not arrays or not len(arrays[0]):
            raise garbage("a read without rows")
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)

    def stop(self) -> None:
        """See `hil.robot.Robot`; a driver that does not answer within a second is killed."""
        self._last_stop = object()
        process = self._process
        if process is not None:
            process.stop()

    def close(self) -> None:
        """See `hil.robot.Robot`: stop, ask, SIGTERM, SIGKILL; a matter of seconds at most."""
        process = self._process
        if process is None:
            return
        try:
            problem = _problem(process.stop)
            if isinstance(problem, RobotConnectionError) and not process.alive:
                problem = None  # it was dead before: nothing is left to be released
            problem = _problem(self._ask_to_close) or problem
        finally:
            process.end()
            self._process = self._identity = None
        if problem:
            raise problem

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
        if facts.checks:
            self.checks = self._checks

    def _ask(self, call: str, timeout_s: float, *what: Any) -> Message:
        process = self._process
        if process is None:
            raise self._not_connected()
        with self._one_call:
            return process.ask(call, timeout_s, *what)

    def _ask_to_close(self) -> None:
        process = self._process
        # Who is stuck in a call keeps the line; the end of it will do, then.
        if process and process.answers and self._one_call.acquire(timeout=CLOSE_S):
            try:
                process.ask("close", CLOSE_S)
            finally:
                self._one_call.release()

    def _drain(self) -> Mapping[str, StructArray]:
        said, arrays = self._ask("drain", COMMAND_S)
        with understood():
            return dict(zip(said["topics"], arrays, strict=True))

    def _checks(self) -> Sequence[Finding]:
        said, _ = self._ask("checks", COMMAND_S)
        with understood():
            return [Finding(**each) for each in said["findings"]]

    def _refuse_if_stopped_since(self, stop: object) -> None:
        """A stop that found no driver, or one that was not at it yet, holds all the same."""
        if self._last_stop is not stop:
            self.close()
            raise CommandRefused("stopped while connecting", hint="connect again")

    def _not_connected(self) -> RobotConnectionError:
        return RobotConnectionError(f"{self._name} is not connected", hint="call connect() first")


def _problem(step: Callable[[], object]) -> HilError | None:
    try:
        step()
    except HilError as error:
        return error
    return None
