"""Asking the interlocks about a block: one that raises, hangs or dawdles is called by its name."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from hil.core import HilError, InterlockTripped, StructArray, origin_of
from hil.engine.interlocks import Interlock, Trip

SLOW_S = 0.25
"""An interlock that takes longer for a block keeps the robot waiting [s]."""

_T = TypeVar("_T")


class Judge:
    """Judges every block by every interlock.

    Args:
        interlocks: In the order in which they are asked.
        now: Monotonic clock [s].
    """

    def __init__(
        self, interlocks: Sequence[Interlock], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._interlocks = tuple(interlocks)
        self._now = now
        self._asking: Interlock | None = None
        # The first block is judged before anything moves: there an interlock may take its time.
        self._armed = False
        self._slow: dict[str, float] = {}

    def violations(self, block: StructArray) -> Iterator[tuple[Interlock, Trip]]:
        """Interlocks that a block violates, each as soon as it has said so.

        Raises:
            InterlockTripped: An interlock raises, or returns no trip: it cannot judge.
        """
        for interlock in self._interlocks:
            trip = self._asked(interlock, interlock.check, block)
            if trip is not None and not isinstance(trip, Trip):
                raise _cannot(interlock, f"check returned {trip!r}, which is no Trip")
            if trip is not None:
                yield interlock, trip
        self._armed = True

    def clear(self, block: StructArray) -> bool:
        """Whether no interlock that pauses is anywhere near its limit in a block."""
        pausing = (i for i in self._interlocks if i.action == "pause")
        return all(self._asked(interlock, interlock.clear, block) for interlock in pausing)

    @property
    def hanging(self) -> InterlockTripped | None:
        """The interlock that is being asked at this moment, as the error of one that hangs."""
        asking = self._asking
        return _cannot(asking, "it did not return for seconds") if asking else None

    @property
    def notes(self) -> list[str]:
        """Interlocks that kept the robot waiting, in words."""
        return [
            f"interlock {name} took up to {seconds:.2g} s for one block: it must not wait"
            for name, seconds in self._slow.items()
        ]

    def _asked(
        self, interlock: Interlock, ask: Callable[[StructArray], _T], block: StructArray
    ) -> _T:
        self._asking, begin = interlock, self._now()
        try:
            return ask(block)
        except HilError:
            raise
        except Exception as error:  # a plug-in may raise anything
            raise _cannot(interlock, f"{type(error).__name__}: {error}", error) from error
        finally:
            self._asking, took = None, self._now() - begin
            if took > SLOW_S and self._armed:
                self._slow[interlock.name] = max(took, self._slow.get(interlock.name, 0.0))


def _cannot(interlock: Interlock, why: str, error: Exception | None = None) -> InterlockTripped:
    """What cannot be judged is not safe: it trips."""
    where = f", raised in {_place(error)}" if error else ""
    return InterlockTripped(
        f"interlock {interlock.name}: {why}",
        hint=f"mend the interlock ({origin_of(interlock)}{where}), or leave it out of the spec",
    )


def _place(error: Exception) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}" if trace else "its check"
