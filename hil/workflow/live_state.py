"""The live view of a run: a small file others may look at while it is going on.

`RUN/.live.json` is replaced whole, at most four times a second for progress and for how the arm
is, and at once when the state changes or something is asked. It is a view: nothing depends on it,
and it goes when the run ends.
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
"""Wall time between two views while nothing special happens [s]."""

LARGEST = 2.0**53
"""What is larger is no count and no time of a run."""

_NEWS = frozenset({"stage", "state", "prompt"})
_PROGRESS = frozenset({"step", "progress"})


class LiveState:
    """An observer that keeps the live view of one run.

    Args:
        run: The run directory.
        arm: Tells how the arm is; None where nobody can.
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
                self._shown = self._looked_at(event["rows"])
                self._write()
            return
        self._standing.take(event)
        if self._standing.state in ENDING:
            self._shown = {}  # the arm is not read any more
        if kind in _NEWS or (kind in _PROGRESS and time.monotonic() >= self._next):
            self._write()

    def close(self) -> None:
        """Remove the view; what comes after is not written any more. Idempotent."""
        with self._writing:
            self._closed = True
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _looked_at(self, rows: StructArray) -> dict[str, Any]:
        """How the arm is; where that cannot be told, prompts and progress still are."""
        assert self._arm is not None
        try:
            return self._arm.of(rows)
        except Exception:  # a driver's rows may be odd in any way
            return {}

    def _write(self) -> None:
        self._next = time.monotonic() + EVERY_S
        about = {"holder": self._holder, "pid": os.getpid(), "updated": utc_now(), "t": time.time()}
        view = {"hil_live": LIVE_VERSION, **self._standing.snapshot(), **self._shown, **about}
        with self._writing, contextlib.suppress(RecordingError):  # a full disk spoils no run here
            if not self._closed:
                write_replacing(self._path, json_line(view).encode() + b"\n")


def forget_live(run: Path) -> None:
    """Take away the view that an attempt has left which died: it is not how the run stands."""
    with contextlib.suppress(OSError):
        (run / LIVE_FILE).unlink()


def read_live(run: Path) -> dict[str, Any]:
    """The live view of a run, or the last one of a run that died; empty when there is none.

    Runs may come from elsewhere: what is not of the kind that is written there is left out.
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
    """Whether it is a number to calculate with: neither NaN nor endless nor longer than a float."""
    known = isinstance(value, int | float) and not isinstance(value, bool)
    return known and -LARGEST < value < LARGEST


_TEXTS = {field.name for field in fields(Standing) if isinstance(field.default, str)}
_NUMBERS = {field.name for field in fields(Standing)} - _TEXTS | {"t", "percent", "left_s"}


def _fits(key: str, value: Any) -> bool:
    """Whether a value is of the kind that its key has."""
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


def _arm(told: Mapping[str, Any]) -> dict[str, Any]:
    """Of every joint all that is told of joints; null where it is not known."""
    arm = _flat(told)
    count = len(arm["joints"])
    for key in FIELDS:
        values = arm[key] if isinstance(arm.get(key), list) else []
        known = [value if _is_number(value) else None for value in values]
        arm[key] = (known + [None] * count)[:count]
    return arm


def _flat(told: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values, and lists of such; odd ones in a list are null, for their places count."""
    kept: dict[str, Any] = {}
    for key, value in told.items():
        if _is_plain(value):
            kept[key] = value
        elif isinstance(value, list):
            kept[key] = [one if _is_plain(one) else None for one in value]
    return kept


def standing_in(view: Mapping[str, Any]) -> Standing:
    """Where a run stands, from its live view; what the view does not say keeps its default."""
    standing = Standing()
    for field in fields(Standing):
        value, default = view.get(field.name), getattr(standing, field.name)
        if _is_number(value) and not isinstance(default, str):
            setattr(standing, field.name, type(default)(value))
        elif isinstance(value, str) and isinstance(default, str):
            setattr(standing, field.name, value)
    return standing


class ArmView:
    """What people are shown of an arm that is being read; judges nothing.

    Args:
        robot: Joint names and the unit of efforts.
        interlocks: What watches over the run.
    """

    def __init__(self, robot: Capabilities, interlocks: Iterable[Interlock]) -> None:
        self._names = list(robot.joint_names)
        self._clock = robot.clock
        self._unit = "A" if robot.effort_kind == "current" else "N·m"
        self._watching = [one for one in interlocks if isinstance(one, HasMargin)]

    def of(self, rows: StructArray) -> dict[str, Any]:
        """The last of some state rows, as `arm` and `interlocks` of the live view.

        An interlock that cannot tell its margin is left out; what it does is its own affair.
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
        for interlock in self._watching:
            try:
                margin = interlock.margin(rows)
                told = margin and {key: _rounded(value) for key, value in margin.to_dict().items()}
            except Exception:  # noqa: S112 - of a plugin, say: the others are shown
                continue
            if margin and told:
                told["subject"] = margin.subject or self._name(margin.joint)
                yield {"name": interlock.name, "action": interlock.action, **told}

    def _name(self, joint: int) -> str:
        """Of a margin that is no joint's (−1) nothing."""
        return self._names[joint] if 0 <= joint < len(self._names) else ""


def _numbers(values: Any) -> list[float | None]:
    """What is not measured is null."""
    return [_rounded(value) for value in values.tolist()]


def _rounded(value: Any) -> Any:
    """Six digits are enough to look at."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if math.isfinite(value) else None
