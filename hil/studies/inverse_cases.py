"""What a study of inverse dynamics fits to and judges on, and the noise its errors stand beside.

A `Case` is one protocol with one seed, the same for every method. Beside every error stand two that
need no model: the noise that the filter leaves in the torque, and repeating the last torque.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import butter, freqz

from hil.arms import Payload
from hil.core import BoolArray, DataError, FloatArray
from hil.data import (
    PART,
    TEST,
    TRAINING,
    VALIDATION,
    Dataset,
    FilterSettings,
    Group,
    assert_disjoint,
    group_of,
    groups,
    nyquist_fraction,
    persistence,
    persistence_rmse,
    prepare,
    sample_rate,
    with_part,
)
from hil.dynamics import RobotModel
from hil.studies.dynamic_methods import (
    SHARES,
    Trajectories,
    held_out,
    light,
    marked,
    trajectories_of,
)


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A run as the study sees it.

    Attributes:
        bare: Trajectories under the first load, which is all that anything is fitted to.
        loaded: The same motions under the other loads, filtered alike; None without.
        notes: What is not as in the paper.
    """

    bare: Trajectories
    loaded: Dataset | None
    notes: tuple[str, ...]


def recorded(whole: Dataset, robot: RobotModel, cutoff_hz: float, rate_hz: float) -> Recorded:
    """The trajectories of a run, apart by load, filtered at their own rate.

    Raises:
        FitError: There are too few trajectories under the first load, or the robot is another.
        DataError: The cut-off is too high for the recorded rate, or for the samples kept.
    """
    data = whole.of_kind("trajectory")
    first = min((condition.load for condition in data.conditions), default=0)
    bare = data.select(lambda condition: condition.load == first)
    trajectories = trajectories_of(bare, robot, cutoff_hz, rate_hz)
    others = data.select(lambda condition: condition.load != first)
    loaded = None
    if others.conditions:
        loaded = light(marked(prepare(others, trajectories.filters)))
    lighter = replace(trajectories, data=light(trajectories.data))
    return Recorded(lighter, loaded, trajectories.notes)


def load_names(data: Dataset) -> dict[int, str]:
    """Name of every load by its number, such as `3 kg`."""
    return {c.load: f"{c.payload.mass:.4g} kg" for c in data.conditions}


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One protocol with one seed: the same for every method.

    Attributes:
        protocol: `honest` or `paper`.
        seed: Of the draw, and of every network.
        learn: Handed to every estimator: all that is not judged, or everything with the column
            `PART` that says so row by row.
        judge: Whole motions, so that what remembers can be carried along.
        rows: (N,) which of their rows are judged.
        loaded: The judged motions under other loads; None without.
        filters: As all of it was filtered, and how fits leave rows out.
        scale: (n,) torque per unit of effort.
    """

    protocol: str
    seed: int
    learn: Dataset
    judge: Dataset
    rows: BoolArray
    loaded: Dataset | None
    filters: FilterSettings
    scale: FloatArray

    def require_honest(self) -> None:
        """Refuse a case whose judged rows can be learned from.

        Raises:
            DataError: Judged rows are among those to learn from.
        """
        if self.protocol == "honest":
            assert_disjoint(self.learn, self.judge)
            if self.loaded is not None:
                assert_disjoint(self.learn, self.loaded)
        elif not np.array_equal(self.rows, self.judge[PART] == TEST):
            raise DataError(
                "rows are judged that were learned from",
                hint=f"judge where the column {PART!r} is {TEST:.0f}",
            )


def honest_case(of: Recorded, seed: int) -> Case:
    """Three of twelve whole trajectories are judged, and nothing else of them is seen."""
    outer = held_out(of.bare, seed)
    held = set(outer.held_out)
    rows = np.ones(len(outer.test), dtype=bool)
    loaded = None if of.loaded is None else _of_groups(of.loaded, held)
    return _case("honest", seed, of, outer.train, outer.test, rows, loaded)


def paper_case(of: Recorded, seed: int) -> Case:
    """60/20/20 % of the recorded samples, drawn one by one along whole motions."""
    data = of.bare.data
    drawn = np.random.default_rng(seed).choice((TRAINING, VALIDATION, TEST), len(data), p=SHARES)
    parted = with_part(data, drawn)
    return _case("paper", seed, of, parted, parted, drawn == TEST, None)


CASES: Mapping[str, Callable[[Recorded, int], Case]] = {"paper": paper_case, "honest": honest_case}
"""By protocol."""


def _case(
    protocol: str, seed: int, of: Recorded, learn: Dataset, judge: Dataset, rows: BoolArray,
    loaded: Dataset | None,
) -> Case:  # fmt: skip
    made = Case(protocol, seed, learn, judge, rows, loaded, of.bare.filters, of.bare.scale)
    made.require_honest()
    return made


def _of_groups(data: Dataset, wanted: set[Group]) -> Dataset | None:
    found = data.select(lambda condition: group_of(condition, "trajectory") in wanted)
    return found if groups(found, "trajectory") else None


def forgotten(data: Dataset) -> Dataset:
    """The same recordings with nobody told about the load."""
    bare = (
        replace(condition, payload=Payload(), payload_identified=None)
        for condition in data.conditions
    )
    return replace(data, conditions=tuple(bare))


FREQUENCIES = 1 << 14

WIDEST = 0.5
"""Of the band: a cut-off above leaves too little beside it to tell noise from signal."""


def white_noise_left(removed: FloatArray, case: Case) -> FloatArray:
    """(n,) RMS of the noise in the filtered torque, if white noise was filtered.

    NaN where the cut-off leaves less than half of the band above it: signal is then most of that.

    Args:
        removed: (n,) RMS of what the filter took out.
        case: Says how it filtered.
    """
    rate = sample_rate(case.judge["t"][: case.judge.offsets[1]])
    settings = case.filters
    fraction = nyquist_fraction(settings.effort, settings.unit, rate)
    if fraction > WIDEST:
        return np.full_like(removed, np.nan)
    b, a = butter(settings.order, fraction)
    # Forwards and backwards: the gain is the square of one pass's magnitude.
    gain = np.abs(freqz(b, a, FREQUENCIES)[1]) ** 2
    share = np.sqrt(np.mean(gain**2) / np.mean((1.0 - gain) ** 2))
    return np.asarray(share * removed)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Torque of a moment ago, repeated.

    Attributes:
        age_s: How old it mostly is: samples come when they come.
        error: (n,) what that leaves [N·m].
    """

    age_s: float
    error: FloatArray


def persistence_of(case: Case, latency_s: float) -> Held:
    """What taking the newest filtered torque that is `latency_s` old for that of now comes to."""
    error = persistence_rmse(case.judge, latency_s, "effort_f", case.rows)
    age = case.judge["t"] - persistence(case.judge, latency_s, "t")
    return Held(float(np.nanmedian(age[case.rows])), error * case.scale)
