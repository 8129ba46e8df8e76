"""Samples of a file of a different tool: raw, in SI units, and with implausible rows marked.

A reader of a file format fills `ForeignSamples` with the numbers of the file and records the
unreadable rows. The method `to_si` applies the import map and records the rows with implausible
values: not finite, beyond a limit or the range of the arm, with invalid time stamps, or further
from their neighbors than an arm can move. This module drops no rows: the import either rejects the
file and lists the implausible rows, or omits these rows.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hil.arms import arm_names, load_arm
from hil.core import BoolArray, DataError, FloatArray, IntArray
from hil.importers.import_map import SI_SYMBOL, ImportMap, Quantity, unit_named

LISTED_ROWS = 10
"""Maximum number of implausible rows listed in a message; their total number is always reported."""


@dataclass(eq=False)
class ForeignSamples:
    """Samples of one file of a different tool.

    Attributes:
        columns: Arrays by name: `t` (N,) and quantities (N, n), NaN if unreadable.
        lines: (N,) position of each sample in the file, starting at 1.
        place: Meaning of the numbers in `lines`: `line`, `message` or `sample`.
        problems: Map from row (starting at 0) to the description of its first problem.
    """

    columns: dict[str, FloatArray]
    lines: IntArray
    place: str = "line"
    problems: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def blame(self, row: int, why: str) -> None:
        """Record a problem of a row, unless a problem of this row is already recorded."""
        self.problems.setdefault(int(row), why)

    @property
    def good(self) -> BoolArray:
        """Mask (N,) of the rows without a problem."""
        keep = np.ones(len(self), dtype=bool)
        keep[list(self.problems)] = False
        return keep

    @property
    def bad_lines(self) -> list[int]:
        """Positions in the file of the rows with a problem."""
        return [int(self.lines[row]) for row in sorted(self.problems)]

    def listing(self) -> Iterator[str]:
        """Yield a text line for each of the first rows with a problem, and a count of the rest."""
        for row in sorted(self.problems)[:LISTED_ROWS]:
            yield f"  {self.place} {self.lines[row]}: {self.problems[row]}"
        if len(self.problems) > LISTED_ROWS:
            yield f"  … and {len(self.problems) - LISTED_ROWS} more"

    def window(self, rows: tuple[int, int]) -> ForeignSamples:
        """Return the rows from first to last, counted from 1, both included.

        Raises:
            DataError: The window of rows is empty or extends beyond the file.
        """
        first, last = rows
        if not 1 <= first <= last <= len(self):
            raise DataError(
                f"rows {first}:{last} are not in the file, which has rows 1:{len(self)}",
                hint="rows are counted from 1, without the header",
            )
        span = slice(first - 1, last)
        shifted = {
            r - span.start: why for r, why in self.problems.items() if first <= r + 1 <= last
        }
        columns = {name: values[span] for name, values in self.columns.items()}
        return ForeignSamples(columns, self.lines[span], self.place, shifted)

    def without_bad_rows(self) -> ForeignSamples:
        """Return only the rows without a problem."""
        keep = self.good
        columns = {name: values[keep] for name, values in self.columns.items()}
        return ForeignSamples(columns, self.lines[keep], self.place)


# Conversion to SI units


def to_si(samples: ForeignSamples, layout: ImportMap) -> ForeignSamples:
    """Return the same rows in SI units, with a problem recorded for each implausible row.

    Raises:
        DataError: A unit in the import map is unknown.
    """
    time = layout.columns.t
    if time.rate_hz is None:
        t = samples.columns["t"] * _factor(time.unit)[0]
    else:
        t = np.arange(len(samples)) / time.rate_hz
    out = ForeignSamples({"t": t}, samples.lines, samples.place, dict(samples.problems))
    _check_values(out, "t", t, np.array([np.inf]), "s")
    for name, quantity in layout.quantities().items():
        if name in samples.columns:
            out.columns[name] = _quantity_to_si(out, name, quantity, samples.columns[name])
    _check_range(out, layout.robot)
    _check_time(out, t)
    fastest = layout.columns.qd and layout.columns.qd.limit
    if fastest and layout.columns.qd is not None:
        limit = np.array(fastest) * _factor(layout.columns.qd.unit)[0]
        _check_jumps(out, t, out.columns["q"], limit)
    return out


def _quantity_to_si(
    out: ForeignSamples, name: str, quantity: Quantity, values: FloatArray
) -> FloatArray:
    factor, offset = _factor(quantity.unit)
    scaled = values * np.array(quantity.scale) + np.array(quantity.offset)
    limit = np.array(quantity.limit or (np.inf,))
    _check_values(out, name, scaled, limit, quantity.unit)
    if quantity.matrix is not None:
        scaled = scaled @ np.array(quantity.matrix).T
    si: FloatArray = scaled * factor + offset
    unit = unit_named(quantity.unit)
    _check_values(out, name, si, np.array([np.inf]), SI_SYMBOL[unit.dimension] if unit else "")
    return si


def _factor(text: str) -> tuple[float, float]:
    unit = unit_named(text)
    if unit is None:
        raise DataError(f"{text!r} is not a unit", hint="see the units in docs/reference/maps.md")
    return unit.factor, unit.offset


# Detection of implausible rows


ABSURD = 1e6
"""Upper bound of the magnitude of every joint quantity in SI units."""

ABSURD_TIME_S = 1e11
"""Upper bound of a time stamp [s], smaller than Unix time in milliseconds declared as seconds."""


def _check_values(
    samples: ForeignSamples, name: str, values: FloatArray, limit: FloatArray, unit: str
) -> None:
    """Record rows of a quantity (N,) or (N, n) that are not finite or exceed `limit`."""
    table = values.reshape(len(values), -1)
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(table) <= np.minimum(limit, ABSURD_TIME_S if name == "t" else ABSURD))
    rows, joints = np.nonzero(wrong)
    for row, joint in zip(rows, joints, strict=True):
        of_joint = "" if name == "t" else f" of joint {joint + 1}"
        samples.blame(int(row), f"{name}{of_joint} is {table[row, joint]:.4g} {unit}")


RANGE_MARGIN = 1.1
"""Factor by which the joint range of an arm is multiplied to detect implausible positions."""


def _check_range(samples: ForeignSamples, robot: str) -> None:
    """Record positions far outside the range of a built-in arm, such as degrees read as rad."""
    if robot not in arm_names() or "q" not in samples.columns:
        return
    arm, q = load_arm(robot), samples.columns["q"]
    reach = RANGE_MARGIN * np.maximum(np.abs(arm.q_min), np.abs(arm.q_max))
    if q.shape[1] == arm.n_joints:
        _check_values(samples, "q", q, reach, f"rad, more than a {robot} can turn")


def _check_time(samples: ForeignSamples, t: FloatArray) -> None:
    """Record the smallest set of rows whose removal makes time increase strictly."""
    good = np.flatnonzero(samples.good)
    if np.all(np.diff(t[good]) > 0):
        return
    kept = np.zeros(len(t), dtype=bool)
    kept[good[_longest_increasing(t[good])]] = True
    for row in good[~kept[good]]:
        samples.blame(row, f"time stamp {t[row]:.6f} s repeats or runs backwards")


def _longest_increasing(t: FloatArray) -> IntArray:
    """Return the indices of a longest strictly increasing subsequence of time stamps.

    Of several samples with the same time stamp, the first sample is used.
    """
    ends: list[float] = []
    at: list[int] = []
    before = np.full(len(t), -1, dtype=np.int64)
    for i, value in enumerate(t.tolist()):
        place = bisect_left(ends, value)
        if place < len(ends) and ends[place] == value:
            continue
        before[i] = at[place - 1] if place else -1
        ends[place : place + 1] = [value]
        at[place : place + 1] = [i]
    chain = [at[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1], dtype=np.int64)


SHORTEST_RUN = 5
"""Minimum number of rows between two position jumps; a shorter group of rows is invalid."""

JUMP_MARGIN_RAD = 0.02


def _check_jumps(
    samples: ForeignSamples, t: FloatArray, q: FloatArray, fastest: FloatArray
) -> None:
    """Record short groups of rows that cannot be reached at the maximum speed.

    The maximum speed `fastest` is in rad/s.
    """
    while True:
        good = np.flatnonzero(samples.good)
        if len(good) <= SHORTEST_RUN:
            return
        allowed = 1.5 * fastest * np.diff(t[good])[:, None] + JUMP_MARGIN_RAD
        jumps = np.flatnonzero(np.any(np.abs(np.diff(q[good], axis=0)) > allowed, axis=1))
        edges = np.concatenate(([0], jumps + 1, [len(good)]))
        short = np.diff(edges) < SHORTEST_RUN
        if not len(jumps) or not short.any():
            return
        for i in np.flatnonzero(short):
            for row in good[edges[i] : edges[i + 1]]:
                samples.blame(row, "the position jumps further than the arm can move")
