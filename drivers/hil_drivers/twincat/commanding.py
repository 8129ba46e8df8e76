"""Motions and loads as commands to the PLC; one that is not answered is followed by a stop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from hil.arms import Payload
from hil.core import CommandRefused, RobotConnectionError, RobotFault, RobotTimeout
from hil.robot import Limits, Segment
from hil_drivers.arm import require_executable
from hil_drivers.twincat.controller import Controller
from hil_drivers.twincat.orders import payload_fields, payload_in
from hil_drivers.twincat.symbols import Order, Phase
from hil_drivers.twincat.watch import Watch

AT_SET_POINT_RAD = 1e-3
"""The PLC begins with the first set-point as it is: it has to be where the arm is held."""

Prepared = tuple[Segment, int]
"""A segment that the PLC has, and the `nStop` with which it may be started."""


def declare(controller: Controller, watch: Watch, payload: Payload) -> Payload:
    """Let the PLC compute with a load; returns what it says that it computes with.

    Raises:
        CommandRefused: It is too heavy, or the arm is moving.
        RobotError: See `Orders.give`.
    """
    with _obeyed(controller, watch):
        answer = controller.orders.give(Order.PAYLOAD, "declare a load", **payload_fields(payload))
    return payload_in(answer)


def prepare(controller: Controller, watch: Watch, segment: Segment, limits: Limits) -> Prepared:
    """Check a segment and upload it; the PLC checks it as well.

    Raises:
        CommandRefused: The arm moves, or the segment cannot be played.
        RobotError: See `Orders.give`.
    """
    with _obeyed(controller, watch):
        state, stops = controller.stops.before_start()
        if state["nPhase"] in (Phase.PLAYING, Phase.STOPPING):
            raise CommandRefused("the arm is still moving", hint="read until it is at rest")
        standing = controller.variables.newest_row()["aQTarget"]
        require_executable(segment, limits, standing, at_set_point_rad=AT_SET_POINT_RAD)
        if segment.kind != "hold":
            controller.load(segment)
    return segment, stops


def start(controller: Controller, watch: Watch, prepared: Prepared) -> None:
    """Begin what was prepared.

    Raises:
        CommandRefused: It was stopped meanwhile.
        RobotError: See `Orders.give`.
    """
    segment, stops = prepared
    order = Order.HOLD if segment.kind == "hold" else Order.START
    what = f"start segment {segment.index} ({segment.kind})"
    with _obeyed(controller, watch):
        controller.orders.give(order, what, nSegment=segment.index, nStop=stops)
    watch.begun(segment.index)


@contextmanager
def _obeyed(controller: Controller, watch: Watch) -> Iterator[None]:
    """A command that gets no answer might be obeyed later: stop, and give no more of them."""
    try:
        yield
    except (RobotTimeout, RobotConnectionError):
        watch.faulty = True
        with suppress(RobotConnectionError):
            controller.stop()
        raise
    except RobotFault:
        watch.faulty = True
        raise
