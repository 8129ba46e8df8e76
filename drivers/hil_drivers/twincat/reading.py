"""Reads the PLC's ring: a block of rows, as long as there is time for it, and what is wrong."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from hil.core import RobotConnectionError, RobotFault, RobotTimeout, StructArray
from hil.robot import Topic
from hil_drivers.twincat.controller import Controller
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.rows import TOPIC, HostClock, reading_rows, state_rows
from hil_drivers.twincat.watch import Watch

LEAST_NAP_S, LEAST_WAIT_S = 1e-3, 0.02
"""Shorter no request may wait for its answer [s]."""

KEPT_S = 5.0
"""Rows of an arm that nobody has moved or read: no more than these are told [s]."""


class Reading:
    """Reads from one connection.

    Args:
        controller: Connected.
        options: Of the arm.
        topic: As `reading_topic` makes it.

    Attributes:
        ring: That is read.
        watch: Follows the arm by what is read.
    """

    def __init__(self, controller: Controller, options: Options, topic: Topic) -> None:
        self._controller, self._options, self._topic = controller, options, topic
        self.ring = controller.variables.ring()
        self.watch = Watch(controller.session, options.late_s)
        self._clock = HostClock()
        self._further: list[StructArray] = []

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def read(self, timeout_s: float) -> StructArray:
        """See `TwinCatRobot.read`."""
        watch, controller = self.watch, self._controller
        problem, watch.problem = watch.problem, None
        if problem is not None:
            raise problem
        # No request waits for longer than whoever reads.
        controller.wait_for(max(timeout_s, LEAST_WAIT_S))
        try:
            state = self._await_rows(timeout_s)
            now = time.time()
            if watch.idle and not watch.moving:
                self.ring.forget(int(state["nHead"]), round(KEPT_S * self._options.rate_hz))
            raw = self.ring.pull(int(state["nHead"]))
        except (RobotConnectionError, RobotFault):
            watch.faulty = True
            raise
        finally:
            controller.wait_for()
        rows = state_rows(raw, int(controller.info["nOffers"]))
        self._clock.stamp(rows, now, 1.0 / self._options.rate_hz)
        self._further.append(reading_rows(rows, raw, self.ring, self._topic))
        watch.see(rows, state, controller.fault)
        return rows

    def _await_rows(self, timeout_s: float) -> np.void:
        """The PLC's state once a block is there, or some rows and no time left for more."""
        asked, wanted, rate = time.monotonic(), self._options.block_rows, self._options.rate_hz
        until = asked + timeout_s
        enough = min(until, asked + 1.5 * wanted / rate)
        while True:
            state = self._state()
            waiting = int(state["nHead"]) - self.ring.next
            now = time.monotonic()
            if waiting >= wanted or waiting < 0 or (waiting and now >= enough):
                return state
            if now >= until:
                raise RobotTimeout(
                    f"{self._controller.where} has written no rows within {timeout_s:g} s",
                    hint="is its task running? TwinCAT shows its cycle",
                )
            nap = (wanted - waiting) / rate / 2
            time.sleep(max(LEAST_NAP_S, min(nap, until - now)))

    def _state(self) -> np.void:
        """`stState`; a PLC that is silent for too long in a motion is given up."""
        watch, controller = self.watch, self._controller
        try:
            state = controller.state()
        except RobotTimeout:
            if watch.moving and watch.silent:
                self._give_up()
            raise
        if not watch.advanced(int(state["nHead"])) and watch.moving:
            self._give_up()
            raise watch.stands_still(controller.where)
        return state

    def _give_up(self) -> None:
        """Both are there when the PLC goes on: the stop, and the silence of our heartbeat."""
        self.watch.faulty = True
        self._controller.beat.hush()
        with suppress(RobotConnectionError):
            self._controller.stop()
