"""Threads for what waits, of each kind its own: whatever else is asked, Stop finds a free one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Literal, ParamSpec, TypeVar

from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

P = ParamSpec("P")
T = TypeVar("T")

Kind = Literal["asking", "starting", "telling"]

AT_MOST: dict[Kind, int] = {"asking": 16, "starting": 8, "telling": 8}
"""Threads of a kind. Asking may wait for a run that has just begun; pages have those of anyio."""

PLANS = threading.BoundedSemaphore(2)
"""Plans that are made at the same time: each takes a core for seconds."""

_limiters: RunVar[dict[Kind, CapacityLimiter]] = RunVar("hil_limiters")


async def in_thread(kind: Kind, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that reads the disk or waits, on a thread of a kind.

    Args:
        kind: `asking` for what is asked of a run, `starting` for what begins one or goes on with
            it, `telling` for what pages are told of.
        function: What is called.
        *args: Its arguments.
        **kwargs: Its arguments by name.
    """
    return await to_thread.run_sync(lambda: function(*args, **kwargs), limiter=_limiter(kind))


def _limiter(kind: Kind) -> CapacityLimiter:
    """One of each kind in an event loop; there is one, but for tests."""
    try:
        made = _limiters.get()
    except LookupError:
        made = {each: CapacityLimiter(most) for each, most in AT_MOST.items()}
        _limiters.set(made)
    return made[kind]
