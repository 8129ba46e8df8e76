"""What a node tells the drive behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


def _nothing(*_: object) -> None:
    """Nobody listens."""


@dataclass(slots=True)
class Hooks:
    """Set by who drives the node; each is called from within `heard`, `synced` or `ticked`.

    Attributes:
        applied: RPDOs have been written into the registers: controlword, set-points.
        written: An SDO client has written an object: its key and new raw value.
        resetting: The node is about to start anew, with all as it was; whether its application
            starts anew, too (reset node).
        nmt_changed: The new NMT state (`nmt.State`).
        booted: The node has started anew; whether its application has, too (reset node).
        connection_lost: Error code (8130h, 8140h, 8250h): what 6007h is the reaction to.
    """

    applied: Callable[[], None] = _nothing
    written: Callable[[int, int], None] = _nothing
    resetting: Callable[[bool], None] = _nothing
    nmt_changed: Callable[[int], None] = _nothing
    booted: Callable[[bool], None] = _nothing
    connection_lost: Callable[[int], None] = _nothing
