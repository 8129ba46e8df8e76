"""Moves of a program on their way, and how far they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hil_mock_robot.ur.motions import Leg, MovePath
from hil_mock_robot.ur.threaded import Steps, Threaded


def follow(
    program: Threaded, legs: Sequence[Leg], reached: Callable[[int], None] = lambda _: None
) -> Steps:
    """Move along a path until its end; a pause is gone on from with the move it fell into.

    Args:
        program: Whose.
        legs: Its moves.
        reached: Told the index of every move when it begins; a blend belongs to the later one.
    """
    machine, begun, first = program.machine, -1, 0

    def make() -> MovePath:
        nonlocal first
        first = max(begun, 0)
        return MovePath(machine.body.arm, machine.tcp, legs[first:], machine.tick_s)

    def note(index: int) -> None:
        nonlocal begun
        while begun < index:
            begun += 1
            reached(begun)

    if legs:
        yield from program.drive(make, watch=lambda motion: note(first + motion.progress))
        note(len(legs) - 1)
