"""Dwells of a recording: phases in which the arm is at rest.

Only the last samples of a dwell, before the arm leaves the pose, are used: by then, friction has
settled, and the controller has stopped oscillating (static paper, section IV.A: ten samples of ≥ 95
ms). The recording of a run with a plan marks the dwells. In a recording without a plan,
`find_dwells` detects dwells from the joint speeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data.dataset import Conditions, Dataset
from hil.data.filters import derivative

SAMPLES_PER_DWELL = 10


@dataclass(frozen=True, slots=True)
class RestRule:
    """Thresholds for the detection of dwells.

    Attributes:
        min_s: Shortest dwell [s].
        samples: Number of samples used, taken from the end of the dwell.
        speed: Maximum speed of every joint in a dwell [rad/s].
        drift: Maximum distance of every joint from its final position in a dwell [rad].
    """

    min_s: float = 0.095
    samples: int = SAMPLES_PER_DWELL
    speed: float = 0.005
    drift: float = 0.002


def find_dwells(
    q: FloatArray,
    qd: FloatArray | None,
    t: FloatArray,
    min_s: float = 0.095,
    samples: int = SAMPLES_PER_DWELL,
    rule: RestRule | None = None,
) -> list[slice]:
    """Return the last `samples` rows of every dwell in a recording without a plan.

    Args:
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s]; None to compute the velocities from `q`.
        t: (N,) time [s].
        min_s: Shortest dwell [s].
        samples: Number of rows used of each dwell.
        rule: Thresholds for speed and drift; `min_s` and `samples` replace the values in `rule`.

    Returns:
        Row ranges of the detected dwells, in the order of time. Dwells shorter than `min_s` or
        `samples` are not returned.
    """
    chosen = replace(rule or RestRule(), min_s=min_s, samples=samples)
    speed = derivative(q, t) if qd is None else qd
    resting = np.max(np.abs(speed), axis=1) < chosen.speed
    dwells = []
    for start, stop in _runs(resting):
        first = start + _settled_from(q[start:stop], chosen.drift)
        # A dwell lasts from its first to its last sample at rest; the tolerance is for rounding.
        long_enough = stop - first >= samples and t[stop - 1] - t[first] >= min_s - 1e-9
        if long_enough:
            dwells.append(slice(stop - samples, stop))
    return dwells


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return start and stop index of every uninterrupted sequence of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _settled_from(q: FloatArray, drift: float) -> int:
    """Return the first row from which every joint stays near its final position."""
    away = np.flatnonzero(np.max(np.abs(q - q[-1]), axis=1) > drift)
    return int(away[-1]) + 1 if len(away) else 0


def dwells_of(dataset: Dataset, rule: RestRule | None = None) -> Dataset:
    """Return the dwell series of a dataset, or the dwells that `find_dwells` detects.

    Detected dwells are numbered as poses in the order of time. Planned dwells that reached their
    time-out are not returned.
    """
    planned = dataset.of_kind("dwell")
    if len(planned.conditions):
        filled = {condition.id for condition, rows in planned.slices() if rows.stop > rows.start}
        return planned.select(lambda condition: condition.settled and condition.id in filled)
    spans: list[tuple[Conditions, slice]] = []
    chosen = rule or RestRule()
    qd = dataset.columns.get("qd")
    for condition, rows in dataset.slices():
        if rows.stop - rows.start < chosen.samples:
            continue
        speed = None if qd is None else qd[rows]
        dwells = find_dwells(
            dataset["q"][rows], speed, dataset["t"][rows], chosen.min_s, chosen.samples, chosen
        )
        spans += [(condition, slice(rows.start + s.start, rows.start + s.stop)) for s in dwells]
    return _as_series(dataset, spans)


def _as_series(dataset: Dataset, spans: list[tuple[Conditions, slice]]) -> Dataset:
    """Return a dataset in which every row range of `spans` is a series of kind `dwell`."""
    rows = [np.arange(span.start, span.stop) for _, span in spans]
    picked = np.concatenate(rows) if rows else np.empty(0, dtype=np.int64)
    conditions = tuple(
        replace(origin, id=f"{origin.id}/dwell{number}", kind="dwell", pose=number)
        for number, (origin, _) in enumerate(spans)
    )
    return replace(
        dataset,
        columns={name: values[picked] for name, values in dataset.columns.items()},
        offsets=np.concatenate(([0], np.cumsum([len(r) for r in rows]))).astype(np.int64),
        conditions=conditions,
        arrivals=None,
    )


def series_means(dataset: Dataset, values: FloatArray) -> FloatArray:
    """Return (S, n) the mean of `values` (N, n) over each series; NaN for an empty series."""
    counts: IntArray = np.diff(dataset.offsets)
    means = np.full((len(counts), values.shape[1]), np.nan)
    filled = counts > 0
    if filled.any():
        sums = np.add.reduceat(values, dataset.offsets[:-1][filled], axis=0)
        means[filled] = sums / counts[filled, None]
    return means
