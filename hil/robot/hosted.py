"""A driver in a process of its own, seen from inside: what it is asked, and how it is let go."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from hil.core import RobotConnectionError, RobotError, StructArray
from hil.robot.documents import error_document, payload_from, segment_from
from hil.robot.facts import facts_document
from hil.robot.findings import HasChecks
from hil.robot.frames import Message
from hil.robot.opening import open_driver
from hil.robot.protocol import HasSpeedScaling, HasTopics, Robot
from hil.robot.state import Status

UNREAD_S = 2.0
"""An arm that moves and is not read for this long is stopped: `hil` was suspended, or hangs [s]."""

REST_S = 5.0
"""How long an arm that was let go is followed to its rest [s]."""

_REST_RAD_S = 0.01


class HostedRobot:
    """One driver and what its process knows about it.

    The thread that answers calls and the one that stops the arm share it: every member of the
    driver but `stop` is called by the first alone.
    """

    def __init__(self) -> None:
        self._robot: Robot | None = None
        self._wall = True
        self._moving = False
        self._busy = False
        self._last_asked = time.monotonic()
        self._complaint = ""
        self._closed = False
        self._letting_go = threading.Lock()
        self._let_go = False
        self._members: dict[str, Callable[..., Message]] = {
            "open": self._open,
            "connect": self._connect,
            "set_payload": self._set_payload,
            "prepare": self._prepare,
            "start": self._start,
            "read": self._read,
            "drain": self._drain,
            "checks": self._checks,
            "close": self._close,
        }

    def answer(self, question: Message) -> Message:
        """Do what is asked; whatever goes wrong is an answer too."""
        asked, arrays = question
        doing = str(asked.get("call"))
        self._busy = True
        try:
            if self._let_go:
                raise RobotConnectionError("the driver's process is about to end")
            if doing not in self._members:
                raise RobotError(f"a driver's process is asked to {doing!r}, which it cannot")
            said, rows = self._members[doing](asked.get("with", {}), arrays)
        # A vendor's library that calls sys.exit must not end the process that can stop the arm.
        except (Exception, SystemExit) as error:
            said, rows = {"error": error_document(error, doing)}, []
        finally:
            self._last_asked = time.monotonic()
            self._busy = False
        return {"id": asked.get("id"), **said}, rows

    @property
    def closed(self) -> bool:
        """Whether the robot was closed by a call: nothing is left to be done then."""
        return self._closed

    def stop(self) -> None:
        """Stop the arm; from any thread. Does nothing before there is a driver."""
        if self._robot is not None:
            self._robot.stop()

    def stop_if_unread(self) -> None:
        """Stop an arm that moves in wall time while nobody reads it; the next call says so."""
        unread = time.monotonic() - self._last_asked
        if self._busy or not (self._moving and self._wall) or unread < UNREAD_S:
            return
        self._moving = False
        self._complaint = (
            f"the arm moved and was not read for {unread:.1f} s: its driver stopped it"
        )
        _tell(self.stop)

    def let_go(self, *, gone: bool) -> None:
        """Stop the arm because nobody commands it any more; once, from any thread.

        Args:
            gone: The other side has vanished, which a mock robot wants to know.
        """
        with self._letting_go:
            if self._let_go or self._closed:
                return
            self._let_go = True
            if gone:
                _tell(getattr(self._robot, "client_gone", None))
            _tell(self.stop)

    def finish(self) -> None:
        """Follow an arm that was let go to its rest, then release it."""
        if self._robot is None or self._closed:
            return
        # Again: a call that was on its way when the other side went may have started a motion.
        _tell(self.stop)
        _tell(self._come_to_rest)
        _tell(self._robot.close)

    def _come_to_rest(self) -> None:
        until = time.monotonic() + REST_S
        while time.monotonic() < until:
            row = self._opened().read()[-1]
            if not row["status"] & Status.MOVING and (np.abs(row["qd"]) < _REST_RAD_S).all():
                return

    def _open(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._robot = open_driver(how)
        return facts_document(self._robot, connected=False), []

    def _connect(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        robot.connect()
        self._wall = robot.capabilities.clock == "wall"
        return facts_document(robot, connected=True), []

    def _set_payload(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        return {"payload": asdict(self._opened().set_payload(payload_from(how)))}, []

    def _prepare(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        self._opened().prepare(segment_from(how, arrays))
        return {}, []

    def _start(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        before, self._moving = self._moving, True
        try:
            self._opened().start()
        except BaseException:
            self._moving = before
            raise
        return {}, []

    def _read(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        self._complain()
        robot = self._opened()
        rows = robot.read(how["timeout_s"])
        self._moving = bool(rows[-1]["status"] & Status.MOVING)
        more = {"speed_scaling": robot.speed_scaling} if isinstance(robot, HasSpeedScaling) else {}
        return more, [rows]

    def _drain(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        fresh = robot.drain() if isinstance(robot, HasTopics) else {}
        return {"topics": list(fresh)}, list(fresh.values())

    def _checks(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        robot = self._opened()
        findings = robot.checks() if isinstance(robot, HasChecks) else ()
        return {"findings": [asdict(finding) for finding in findings]}, []

    def _close(self, how: dict[str, Any], arrays: Sequence[StructArray]) -> Message:
        try:
            self._opened().close()
        finally:
            # Before the answer: the end of the line that follows it is nobody's vanishing.
            self._closed = True
        return {}, []

    def _opened(self) -> Robot:
        if self._robot is None:
            raise RobotConnectionError("the driver was not opened")
        return self._robot

    def _complain(self) -> None:
        complaint, self._complaint = self._complaint, ""
        if complaint:
            raise RobotConnectionError(
                complaint, hint="was hil suspended? let it run, and resume the run"
            )


def _tell(member: Callable[[], object] | None) -> None:
    """Call something that must not keep what comes after it from being done."""
    try:
        if member is not None:
            member()
    except Exception:
        traceback.print_exc()
