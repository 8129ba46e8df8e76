"""Live view of a run: the file `RUN/.live.json`, from which other processes observe a live run.

The live view is replaced atomically: at most four times a second for progress and the state of the
arm, and at once if the run changes its state or shows a prompt. No function of the run depends on
the live view, and the file is removed when the run ends. Readers of the live view check every
value, because a run directory may come from a different computer.
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
"""Minimum wall time between two writes of the live view [s]; state changes and prompts are
written at once."""

LARGEST = 2.0**53
"""Upper bound for every count and every time of a run."""

_NEWS = frozenset({"stage", "state", "prompt"})
_PROGRESS = frozenset({"step", "progress"})


class LiveState:
    """Observer that writes the live view of one run.

    Args:
        run: Run directory.
        arm: Description that turns a row into the state of the arm; None for a view without the
            arm.
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
                except Exception:  # rows of a driver may be invalid: show the rest
                    self._shown = {}
                self._write()
            return
        self._standing.take(event)
        if self._standing.state in ENDING:
            self._shown = {}  # the arm is no longer read
        if kind in _NEWS or (kind in _PROGRESS and time.monotonic() >= self._next):
            self._write()

    def close(self) -> None:
        """Remove the live view and ignore later events; a second call has no effect."""
        with self._writing:
            self._closed = True
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _write(self) -> None:
        self._next = time.monotonic() + EVERY_S
        about = {"holder": self._holder, "pid": os.getpid(), "updated": utc_now(), "t": time.time()}
        view = {"hil_live": LIVE_VERSION, **self._standing.snapshot(), **self._shown, **about}
        with self._writing, contextlib.suppress(RecordingError):  # not fatal for the run
            if not self._closed:
                write_replacing(self._path, json_line(view).encode() + b"\n")


def forget_live(run: Path) -> None:
    """Remove the live view of an attempt whose process died, because it is out of date."""
    with contextlib.suppress(OSError):
        (run / LIVE_FILE).unlink()


def read_live(run: Path) -> dict[str, Any]:
    """Return the live view of a run; empty if the run has no live view.

    If the process of the run died, the last live view that it wrote is returned. Values of an
    unexpected type are left out of the returned view.
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
    """Return whether a value is a finite number that a float represents exactly."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and -LARGEST < value < LARGEST


_TEXTS = {field.name for field in fields(Standing) if isinstance(field.default, str)}
_NUMBERS = {field.name for field in fields(Standing)} - _TEXTS | {"t", "percent", "left_s"}


def _fits(key: str, value: Any) -> bool:
    """Return whether a value has the type that its key requires."""
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
"""Names of the fields of the state record, by key in the live view."""


def _arm(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arm entry with one value per joint for each quantity; null for unknown values."""
    arm = _flat(written)
    count = len(arm["joints"])
    for key in FIELDS:
        values = arm[key] if isinstance(arm.get(key), list) else []
        numbers = [value if _is_number(value) else None for value in values]
        arm[key] = (numbers + [None] * count)[:count]
    return arm


def _flat(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain values and the lists of plain values; other list elements become null."""
    flat: dict[str, Any] = {}
    for key, value in written.items():
        if _is_plain(value):
            flat[key] = value
        elif isinstance(value, list):
            flat[key] = [one if _is_plain(one) else None for one in value]
    return flat


def standing_in(view: Mapping[str, Any]) -> Standing:
    """Return the `Standing` of a run from its live view, with defaults for missing values."""
    standing = Standing()
    for field in fields(Standing):
        value, default = view.get(field.name), getattr(standing, field.name)
        if _is_number(value) and not isinstance(default, str):
            setattr(standing, field.name, type(default)(value))
        elif isinstance(value, str) and isinstance(default, str):
            setattr(standing, field.name, value)
    return standing


class ArmView:
    """Description of an arm for the live view, which evaluates no interlock.

    Args:
        robot: Capabilities of the robot, with joint names and kind of effort.
        interlocks: Interlocks of the run.
    """

    def __init__(self, robot: Capabilities, interlocks: Iterable[Interlock]) -> None:
        self._names = list(robot.joint_names)
        self._clock = robot.clock
        self._unit = "A" if robot.effort_kind == "current" else "N·m"
        self._interlocks = [one for one in interlocks if isinstance(one, HasMargin)]

    def of(self, rows: StructArray) -> dict[str, Any]:
        """Return the last row as the `arm` and `interlocks` entries of the live view.

        An interlock without a margin is left out of the entry.
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
    """Return the values in a form for JSON; null for values that are not measured."""
    return [_rounded(value) for value in values.tolist()]


def _rounded(value: Any) -> Any:
    """Return a value rounded to six significant digits; None for NaN and infinity."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if math.isfinite(value) else None
