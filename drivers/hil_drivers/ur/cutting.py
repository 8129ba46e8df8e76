"""The byte stream of a started controller, cut into packages; nothing is dropped unnoticed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hil_drivers.ur.rtde_wire import (
    HEADER,
    KINDS,
    SHORTEST,
    Kind,
    Layout,
    TextMessage,
    text_message,
)

BACK_IS_REBOOT_S = 1.0
"""A clock that goes back further than this was started anew [s]."""

LONG_STEP = 1.5
"""Ticks between two states; from here on states are missing."""

NETWORK = "look at cable and switch; connect the robot directly"


@dataclass(slots=True)
class Counts:
    """What has come since the connection was opened.

    Attributes:
        packages: Of data.
        missing: Data packages that are not there, by the time stamps of those around them.
        duplicates: Data packages with the time stamp of the one before.
        texts: Text messages.
        others: Packages of other kinds, which a started controller has no reason to send.
        deepest: Most rows that have waited to be taken.
    """

    packages: int = 0
    missing: int = 0
    duplicates: int = 0
    texts: int = 0
    others: int = 0
    deepest: int = 0


class Cutter:
    """Cuts what a socket gives, anywhere it likes, into whole packages.

    Args:
        layout: Of the data packages.
        frequency_hz: How many of them there should be in a second.

    Attributes:
        counts: See `Counts`.
        texts: Text messages since they were last taken away.
        problem: What is wrong with the stream and how to mend it; nothing is cut after that.
    """

    def __init__(self, layout: Layout, frequency_hz: float) -> None:
        self._layout, self._frequency_hz = layout, frequency_hz
        self._rest = b""
        self._newest = float("nan")
        self.counts = Counts()
        self.texts: list[TextMessage] = []
        self.problem: tuple[str, str] | None = None

    @property
    def torn(self) -> int:
        """Bytes of a package that is not whole yet."""
        return len(self._rest)

    def feed(self, data: bytes, host_time: float) -> bytes:
        """The whole data packages that have come, one after the other.

        Args:
            data: What came.
            host_time: When, Unix time [s].
        """
        if self.problem is not None:
            return b""
        data = self._rest + data if self._rest else data
        runs, at = [], 0
        while len(data) - at >= SHORTEST and self.problem is None:
            if count := self._layout.whole_packages(data, at):
                end = at + count * self._layout.size
                runs.append(self._in_order(data[at:end]))
                at = end
                continue
            length = self._other(data, at, host_time)
            if not length:
                break
            at += length
        self._rest = data[at:]
        return runs[0] if len(runs) == 1 else b"".join(runs)

    def _other(self, data: bytes, at: int, host_time: float) -> int:
        """Length of a package that is not one of ours; 0 as long as it is not whole, or wrong."""
        size, kind = map(int, HEADER.unpack_from(data, at))
        if kind not in KINDS or size < SHORTEST:
            raw = data[at : at + 16].hex(" ")
            self.problem = (f"sends bytes that are no RTDE package: {raw}", NETWORK)
        elif kind == Kind.DATA:
            self._judge_data(data, at, size)
        elif len(data) - at >= size:
            if kind == Kind.TEXT:
                self.counts.texts += 1
                content = data[at + HEADER.size : at + size]
                self.texts.append(text_message(content, host_time))
            else:
                self.counts.others += 1
            return size
        return 0

    def _judge_data(self, data: bytes, at: int, size: int) -> None:
        """A data package that is not whole yet, or is none of this recipe."""
        expected = self._layout.size
        if size != expected:
            self.problem = (f"sent a data package of {size} bytes instead of {expected}", NETWORK)
        elif len(data) - at > HEADER.size and not self._layout.is_head(data, at):
            recipe = data[at + HEADER.size]
            self.problem = (f"sent a data package of recipe {recipe}, which is not ours", NETWORK)

    def _in_order(self, packages: bytes) -> bytes:
        """Count by the time stamps; packages from where the clock is wrong are cut off."""
        if len(packages) == self._layout.size:
            return self._next(packages)
        times = np.append(self._newest, self._layout.times(packages))
        # The step to the very first one is NaN: neither a gap nor a step back.
        steps = np.diff(times)
        wrong = (steps < 0) | ~np.isfinite(times[1:])
        if wrong.any():
            first = int(np.argmax(wrong))
            self.problem = _went_back(times[first], times[first + 1])
            steps, times = steps[:first], times[: first + 1]
        self._newest = float(times[-1])
        ticks = steps * self._frequency_hz
        gaps = ticks[ticks > LONG_STEP]
        self.counts.packages += len(steps)
        self.counts.duplicates += int((steps == 0).sum())
        self.counts.missing += int(np.rint(gaps).sum()) - len(gaps)
        return packages[: len(steps) * self._layout.size]

    def _next(self, package: bytes) -> bytes:
        """The same for one package, as it is at a robot's own pace: numpy costs five times more."""
        now = self._layout.time(package)
        step = now - self._newest
        if step < 0 or not math.isfinite(now):
            self.problem = _went_back(self._newest, now)
            return b""
        self._newest = now
        self.counts.packages += 1
        if step == 0:
            self.counts.duplicates += 1
        elif step * self._frequency_hz > LONG_STEP:
            self.counts.missing += round(step * self._frequency_hz) - 1
        return package


def _went_back(before: float, now: float) -> tuple[str, str]:
    if not math.isfinite(now):
        return f"says that its clock is at {now} s", NETWORK
    if before - now > BACK_IS_REBOOT_S:
        return (
            f"was restarted: its clock went back from {before:.3f} s to {now:.3f} s",
            "wait until the robot is up, see to it, connect again",
        )
    return f"sent states out of order: {now:.3f} s after {before:.3f} s", NETWORK
