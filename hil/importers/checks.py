"""Which rows make no sense: not finite, beyond limits, out of time, or impossible jumps."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.importers.raw import Raw

ABSURD = 1e6
"""No joint quantity in SI units is larger."""

ABSURD_TIME_S = 1e11
"""Unix time in milliseconds that was declared as seconds is larger."""

SHORTEST_RUN = 5
"""Rows between two impossible jumps; fewer are garbage, more are a recording."""

JUMP_MARGIN_RAD = 0.02


def check_values(raw: Raw, name: str, values: FloatArray, limit: FloatArray, unit: str) -> None:
    """Blame rows of a quantity (N,) or (N, n) that are not finite or beyond `limit`."""
    table = values.reshape(len(values), -1)
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(table) <= np.minimum(limit, ABSURD_TIME_S if name == "t" else ABSURD))
    rows, joints = np.nonzero(wrong)
    for row, joint in zip(rows, joints, strict=True):
        of_joint = "" if name == "t" else f" of joint {joint + 1}"
        raw.blame(int(row), f"{name}{of_joint} is {table[row, joint]:.4g} {unit}")


def check_time(raw: Raw, t: FloatArray) -> None:
    """Blame the fewest rows without which time increases strictly."""
    good = np.flatnonzero(raw.good)
    if np.all(np.diff(t[good]) > 0):
        return
    kept = np.zeros(len(t), dtype=bool)
    kept[good[_longest_increasing(t[good])]] = True
    for row in good[~kept[good]]:
        raw.blame(row, f"time stamp {t[row]:.6f} s repeats or runs backwards")


def check_jumps(raw: Raw, t: FloatArray, q: FloatArray, fastest: FloatArray) -> None:
    """Blame short runs of rows that no arm could have reached or left at its `fastest` [rad/s]."""
    while True:
        good = np.flatnonzero(raw.good)
        if len(good) <= SHORTEST_RUN:
            return
        allowed = 1.5 * fastest * np.diff(t[good])[:, None] + JUMP_MARGIN_RAD
        jumps = np.flatnonzero(np.any(np.abs(np.diff(q[good], axis=0)) > allowed, axis=1))
        edges = np.concatenate(([0], jumps + 1, [len(good)]))
        short = np.diff(edges) < SHORTEST_RUN
        if not len(jumps) or not short.any():
            return
        for row in good[_rows_of_runs(edges, short)]:
            raw.blame(row, "the position jumps further than the arm can move")


def _rows_of_runs(edges: IntArray, chosen: BoolArray) -> IntArray:
    spans = [np.arange(edges[i], edges[i + 1]) for i in np.flatnonzero(chosen)]
    return np.concatenate(spans)


def _longest_increasing(t: FloatArray) -> IntArray:
    """Indices of a longest strictly increasing subsequence; of equal stamps the first stays."""
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
