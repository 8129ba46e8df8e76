"""The live view of a run: the file `RUN/.live.json`, by which other processes watch a live run.

It is replaced whole, at most four times a second for progress and for the state of the arm, and at
once when the run changes its state or shows a prompt. It is a view: nothing depends on it, and it
is removed when the run ends. Readers check every value, as runs may come from elsewhere.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    RecordingError,
    StructArray,
    json_line,
    read_json,
    run_holder,
    write_replacing,
)
from hil.engine import ENDING, HasMargin, Interlock, Standing
from hil.recording import utc_now
from hil.robot import Capabilities, Status

LIVE_FILE = ".live.json"
LIVE_VERSION = 1

EVERY_S = 0.25
"""Least wall time between two views, but for changes of state and prompts [s]."""

LARGEST = 2.0**53
"""No count and no time of a run is larger."""

_NEWS = frozenset({"stage", "state", "prompt"})
_PROGRESS = frozenset({"step", "progress"})


class LiveState:
    """An observer that writes the live view of one run.

    Args:
        run: The run directory.
        arm: Describes the arm by its rows; None for a view without it.
    """

    wants_rows = True
    rows_every_s = EVERY_S

    def __init__(self, run: Path, arm: ArmView | None = None) -> None:
        self._path = run / LIVE_FILE
        holder = run_holder(run)
        self._holder = holder.id if holder else ""
        self._arm, self._shown = arm, dict[str, Any]()
        self._standing = Standing()
        self._next = 0.0
        self._writing = threading.Lock()
        self._closed = False

    def notify(self, event: Mapping[str, Any]) -> None:
        """See `hil.engine.Observer`."""
        kind = event.get("kind")
        if kind == "rows":
            if self._arm is not None:
                try:
                    self._shown = self._arm.of(event["rows"])
                except Exception:  # a driver's rows may be odd; the view has the rest all the same
                    self._shown = {}
                self._write()
            return
        self._standing.take(event)
        if self._standing.state in ENDING:
            self._shown = {}  # the arm is not read any more
        if kind in _NEWS or (kind in _PROGRESS and time.monotonic() >= self._next):
            self._write()

    def close(self) -> None:
        """Remove the view; later events are not written any more. Idempotent."""
        with self._writing:
            self._closed = True
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _write(self) -> None:
        self._next = time.monotonic() + EVERY_S
        about = {"holder": self._holder, "pid": os.getpid(), "updated": utc_now(), "t": time.time()}
        view = {"hil_live": LIVE_VERSION, **self._standing.snapshot(), **self._shown, **about}
        with self._writing, contextlib.suppress(RecordingError):  # no run ends for lack of a view
            if not self._closed:
                write_replacing(self._path, json_line(view).encode() + b"\n")


def forget_live(run: Path) -> None:
    """Remove the view of an attempt whose process died: it says nothing of the present one."""
    with contextlib.suppress(OSError):
        (run / LIVE_FILE).unlink()


def read_live(run: Path) -> dict[str, Any]:
    """Return the live view of a run, or the last one of a run that died; empty without one.

    Values of another kind than are written there are left out.
    """
    try:
        view = read_json(run / LIVE_FILE)
    except DataError:
        return {}
    plain = {key: value for key, value in view.items() if _is_plain(value) and _fits(key, value)}
    if isinstance(view.get("arm"), dict) and isinstance(view["arm"].get("joints"), list):
        plain["arm"] = _arm(view["arm"])
    if isinstance(view.get("interlocks"), list):
        plain["interlocks"] = [_flat(one) for one in view["interlocks"] if isinstance(one, dict)]
    return plain


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, str | bool) or _is_number(value)


def _is_number(value: Any) -> bool:
    """Return whether a value is a number to calculate with: finite, and exact as a float."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and -LARGEST < value < LARGEST


_TEXTS = {field.name for field in fields(Standing) if isinstance(field.default, str)}
_NUMBERS = {field.name for field in fields(Standing)} - _TEXTS | {"t", "percent", "left_s"}


def _fits(key: str, value: Any) -> bool:
    """Return whether a value is of the kind that its key has."""
    if key in _NUMBERS:
        return _is_number(value)
    return isinstance(value, str) or key not in _TEXTS


FIELDS = {
    "q_rad": "q",
    "qd_rad_s": "qd",
    "effort": "effort",
    "temperature_c": "temperature",
    "q_target_rad": "q_target",
}
"""Key in the view → field of the state record."""


def _arm(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arm with a value per joint for each quantity; null if it is not known."""
    arm = _flat(written)
    count = len(arm["joints"])
    for key in FIELDS:
        values = arm[key] if isinstance(arm.get(key), list) else []
        numbers = [value if _is_number(value) else None for value in values]
        arm[key] = (numbers + [None] * count)[:count]
    return arm


def _flat(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain values and the lists of such; odd ones in a list are null."""
    flat: dict[str, Any] = {}
    for key, value in written.items():
        if _is_plain(value):
            flat[key] = value
        elif isinstance(value, list):
            flat[key] = [one if _is_plain(one) else None for one in value]
    return flat


def standing_in(view: Mapping[str, Any]) -> Standing:
    """Return where a run stands, by its live view; what the view lacks has its default."""
    standing = Standing()
    for field in fields(Standing):
        value, default = view.get(field.name), getattr(standing, field.name)
        if _is_number(value) and not isinstance(default, str):
            setattr(standing, field.name, type(default)(value))
        elif isinstance(value, str) and isinstance(default, str):
            setattr(standing, field.name, value)
    return standing


class ArmView:
    """Describes an arm that is being read, for the live view; judges nothing.

    Args:
        robot: With joint names and the unit of efforts.
        interlocks: Those of the run.
    """

    def __init__(self, robot: Capabilities, interlocks: Iterable[Interlock]) -> None:
        self._names = list(robot.joint_names)
        self._clock = robot.clock
        self._unit = "A" if robot.effort_kind == "current" else "N·m"
        self._interlocks = [one for one in interlocks if isinstance(one, HasMargin)]

    def of(self, rows: StructArray) -> dict[str, Any]:
        """Return the last row as the `arm` and `interlocks` entries of the live view.

        An interlock without a margin is left out.
        """
        row = rows[-1]
        arm = {
            "device_time_s": float(row["device_time"]),
            "joints": self._names,
            "effort_unit": self._unit,
            "clock": self._clock,
            "moving": bool(row["status"] & Status.MOVING),
            **{key: _numbers(row[field]) for key, field in FIELDS.items()},
        }
        return {"arm": arm, "interlocks": list(self._margins(rows))}

    def _margins(self, rows: StructArray) -> Iterable[dict[str, Any]]:
        for interlock in self._interlocks:
            try:
                margin = interlock.margin(rows)
                facts = margin and {key: _rounded(value) for key, value in margin.to_dict().items()}
            except Exception:  # noqa: S112 - it may be a plug-in: the others are shown
                continue
            if margin and facts:
                joint = self._names[margin.joint] if 0 <= margin.joint < len(self._names) else ""
                facts["subject"] = margin.subject or joint
                yield {"name": interlock.name, "action": interlock.action, **facts}


def _numbers(values: Any) -> list[float | None]:
    """Return values for JSON; what is not measured is null."""
    return [_rounded(value) for value in values.tolist()]


def _rounded(value: Any) -> Any:
    """Return a value with six digits, which are enough to look at; NaN and infinity as None."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if math.isfinite(value) else None
