"""A robot whose driver lives in a process of its own: it may hang or die, and the arm is stopped.

Decision record 0014 says why, what happens when either side goes, and what a call costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, HilError, RobotConnectionError, StructArray
from hil.robot.documents import payload_from, segment_document, understood
from hil.robot.frames import garbage
from hil.robot.hosting_process import COMMAND_S, HostingProcess
from hil.robot.protocol import Capabilities, Identity, Limits, Segment

CONNECT_S = 120.0
CLOSE_S = 3.0
"""How long the driver may take to connect, to close [s]."""

READ_GRACE_S = {"wall": 1.0, "virtual": 10.0}
"""How much longer than its own time-out a read may take; a virtual clock may be slow [s]."""


class RobotProcess(HostingProcess):
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

    _last_stop: object = None
    """A new one with every stop: told apart without a lock."""

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
        said, arrays = self._ask("read", patience_s, {"timeout_s": timeout_s})
        if "speed_scaling" in said:
            self.speed_scaling = float(said["speed_scaling"])
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

    def _ask_to_close(self) -> None:
        process = self._process
        # Who is stuck in a call keeps the line; the end of it will do, then.
        if process and process.answers and self._one_call.acquire(timeout=CLOSE_S):
            try:
                process.ask("close", CLOSE_S)
            finally:
                self._one_call.release()

    def _refuse_if_stopped_since(self, stop: object) -> None:
        """A stop that found no driver, or one that was not at it yet, holds all the same."""
        if self._last_stop is not stop:
            self.close()
            raise CommandRefused("stopped while connecting", hint="connect again")


def _problem(step: Callable[[], object]) -> HilError | None:
    try:
        step()
    except HilError as error:
        return error
    return None
