"""Samples of a foreign file: as they stand in it, in SI units, and which rows make no sense.

A reader fills `ForeignSamples` with the numbers of a file and notes the rows that it could not
read. `to_si` applies the import map and notes the rows with values that cannot be: not finite,
beyond a limit or the arm's range, out of time, or further from their neighbours than an arm moves.
Nothing is dropped here: the import either refuses the file with these rows listed or leaves them
out.
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
"""Bad rows that are listed in a message; their number is always given."""


@dataclass(eq=False)
class ForeignSamples:
    """The samples of one file.

    Attributes:
        columns: `t` (N,) and quantities (N, n), NaN where nothing could be read.
        lines: (N,) where each sample stands in the file, counted from 1.
        place: What `lines` counts: `line`, `message` or `sample`.
        problems: Row (from 0) → what is wrong with it; the first problem of a row counts.
    """

    columns: dict[str, FloatArray]
    lines: IntArray
    place: str = "line"
    problems: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def blame(self, row: int, why: str) -> None:
        """Note what is wrong with a row, unless it has a problem already."""
        self.problems.setdefault(int(row), why)

    @property
    def good(self) -> BoolArray:
        """(N,) rows without a problem."""
        keep = np.ones(len(self), dtype=bool)
        keep[list(self.problems)] = False
        return keep

    @property
    def bad_lines(self) -> list[int]:
        """Where the bad rows stand in the file."""
        return [int(self.lines[row]) for row in sorted(self.problems)]

    def listing(self) -> Iterator[str]:
        """Yield the first bad rows, one line each, and how many more there are."""
        for row in sorted(self.problems)[:LISTED_ROWS]:
            yield f"  {self.place} {self.lines[row]}: {self.problems[row]}"
        if len(self.problems) > LISTED_ROWS:
            yield f"  … and {len(self.problems) - LISTED_ROWS} more"

    def window(self, rows: tuple[int, int]) -> ForeignSamples:
        """Return rows first…last, counted from 1, both included.

        Raises:
            DataError: The window is empty or leaves the file.
        """
        first, last = rows
        if not 1 <= first <= last <= len(self):
            raise DataError(
                f"rows {first}:{last} are not in the file, which has rows 1:{len(self)}",
                hint="rows count from 1, the header is not one of them",
            )
        span = slice(first - 1, last)
        shifted = {
            r - span.start: why for r, why in self.problems.items() if first <= r + 1 <= last
        }
        columns = {name: values[span] for name, values in self.columns.items()}
        return ForeignSamples(columns, self.lines[span], self.place, shifted)

    def without_bad_rows(self) -> ForeignSamples:
        """Return only the good rows."""
        keep = self.good
        columns = {name: values[keep] for name, values in self.columns.items()}
        return ForeignSamples(columns, self.lines[keep], self.place)


# From the file's numbers to SI units


def to_si(samples: ForeignSamples, layout: ImportMap) -> ForeignSamples:
    """Return the same rows in SI units, with the rows noted that make no sense.

    Raises:
        DataError: A unit is unknown.
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
        raise DataError(f"{text!r} is no unit", hint="see the units in docs/reference/maps.md")
    return unit.factor, unit.offset


# Rows that make no sense


ABSURD = 1e6
"""No joint quantity in SI units is larger."""

ABSURD_TIME_S = 1e11
"""Unix time in milliseconds that was declared as seconds is larger."""


def _check_values(
    samples: ForeignSamples, name: str, values: FloatArray, limit: FloatArray, unit: str
) -> None:
    """Note rows of a quantity (N,) or (N, n) that are not finite or beyond `limit`."""
    table = values.reshape(len(values), -1)
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(table) <= np.minimum(limit, ABSURD_TIME_S if name == "t" else ABSURD))
    rows, joints = np.nonzero(wrong)
    for row, joint in zip(rows, joints, strict=True):
        of_joint = "" if name == "t" else f" of joint {joint + 1}"
        samples.blame(int(row), f"{name}{of_joint} is {table[row, joint]:.4g} {unit}")


RANGE_MARGIN = 1.1
"""Times the range of a joint."""


def _check_range(samples: ForeignSamples, robot: str) -> None:
    """Note positions far outside a built-in arm's range: degrees that were declared as radians."""
    if robot not in arm_names() or "q" not in samples.columns:
        return
    arm, q = load_arm(robot), samples.columns["q"]
    reach = RANGE_MARGIN * np.maximum(np.abs(arm.q_min), np.abs(arm.q_max))
    if q.shape[1] == arm.n_joints:
        _check_values(samples, "q", q, reach, f"rad, more than a {robot} can turn")


def _check_time(samples: ForeignSamples, t: FloatArray) -> None:
    """Note the fewest rows without which time increases strictly."""
    good = np.flatnonzero(samples.good)
    if np.all(np.diff(t[good]) > 0):
        return
    kept = np.zeros(len(t), dtype=bool)
    kept[good[_longest_increasing(t[good])]] = True
    for row in good[~kept[good]]:
        samples.blame(row, f"time stamp {t[row]:.6f} s repeats or runs backwards")


def _longest_increasing(t: FloatArray) -> IntArray:
    """Return indices of a longest strictly increasing subsequence, the first of equal stamps."""
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
"""Rows between two impossible jumps; fewer are garbage, more are a recording."""

JUMP_MARGIN_RAD = 0.02


def _check_jumps(
    samples: ForeignSamples, t: FloatArray, q: FloatArray, fastest: FloatArray
) -> None:
    """Note short runs of rows that no arm could have reached or left at its `fastest` [rad/s]."""
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
