"""Training and test data of the inverse-dynamics study, and reference errors that require no model.

A `Case` contains the data of one protocol with one random seed; all methods use the same cases. The
tables compare every error with two reference errors: the noise that the filter leaves in the
torque, and the error of repeating the last torque (persistence).
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
    """Trajectories of a run, separated by the payload of the arm.

    Attributes:
        bare: Trajectories with the first payload; all models are fitted to these trajectories only.
        loaded: The same motions with the other payloads, filtered like `bare`; None if the run has
            no other payloads.
        notes: Texts that describe differences from the data of the paper.
    """

    bare: Trajectories
    loaded: Dataset | None
    notes: tuple[str, ...]


def recorded(whole: Dataset, robot: RobotModel, cutoff_hz: float, rate_hz: float) -> Recorded:
    """Return the trajectories of a run, separated by payload and filtered at the recorded rate.

    Raises:
        FitError: There are too few trajectories with the first payload, or the data are from a
            different robot.
        DataError: The cut-off frequency is too high for the recorded or the downsampled rate.
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
    """Return the display name of every payload by its number, for example `3 kg`."""
    return {c.load: f"{c.payload.mass:.4g} kg" for c in data.conditions}


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Data of one protocol with one random seed, equal for every method.

    Attributes:
        protocol: Name of the protocol, `honest` or `paper`.
        seed: Random seed of the split and of every network.
        learn: Training data passed to every estimator. Under the `honest` protocol, the training
            data exclude the test data. Under the `paper` protocol, the training data are all data,
            and the column `PART` marks the part of the split that each row belongs to.
        judge: Test data as whole motions, because models with memory need the complete path.
        rows: (N,) mask of the rows of `judge` on which the models are tested.
        loaded: Test motions with other payloads; None if the run has no other payloads.
        filters: Filter settings of all data, and downsampling settings of the fits.
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
        """Raise if an estimator could use test rows for training.

        Raises:
            DataError: Some test rows are among the training rows.
        """
        if self.protocol == "honest":
            assert_disjoint(self.learn, self.judge)
            if self.loaded is not None:
                assert_disjoint(self.learn, self.loaded)
        elif not np.array_equal(self.rows, self.judge[PART] == TEST):
            raise DataError(
                "test rows are among the training rows",
                hint=f"evaluate only rows whose column {PART!r} is {TEST:.0f}",
            )


def honest_case(of: Recorded, seed: int) -> Case:
    """Return a `Case` that holds out three of twelve whole trajectories for testing."""
    outer = held_out(of.bare, seed)
    held = set(outer.held_out)
    rows = np.ones(len(outer.test), dtype=bool)
    loaded = None if of.loaded is None else _of_groups(of.loaded, held)
    return _case("honest", seed, of, outer.train, outer.test, rows, loaded)


def paper_case(of: Recorded, seed: int) -> Case:
    """Return a case that splits the recorded samples at random, 60/20/20 %."""
    data = of.bare.data
    drawn = np.random.default_rng(seed).choice((TRAINING, VALIDATION, TEST), len(data), p=SHARES)
    parted = with_part(data, drawn)
    return _case("paper", seed, of, parted, parted, drawn == TEST, None)


CASES: Mapping[str, Callable[[Recorded, int], Case]] = {"paper": paper_case, "honest": honest_case}
"""Functions that create a `Case`, by name of the protocol."""


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
    """Return the same recordings without information about the payload."""
    bare = (
        replace(condition, payload=Payload(), payload_identified=None)
        for condition in data.conditions
    )
    return replace(data, conditions=tuple(bare))


FREQUENCIES = 1 << 14

WIDEST = 0.5
"""Maximum cut-off frequency as a share of the Nyquist frequency.

If the cut-off frequency is higher than this share, the removed frequency band is too narrow to
estimate the noise.
"""


def white_noise_left(removed: FloatArray, case: Case) -> FloatArray:
    """Return the (n,) RMS of the noise in the filtered torque, assuming white measurement noise.

    The noise is NaN if the cut-off frequency exceeds half of the Nyquist frequency (`WIDEST`),
    because the removed part then consists mostly of signal.

    Args:
        removed: (n,) RMS of the part of the torque that the filter removes.
        case: Case with the filter settings and the sample rate.
    """
    rate = sample_rate(case.judge["t"][: case.judge.offsets[1]])
    settings = case.filters
    fraction = nyquist_fraction(settings.effort, settings.unit, rate)
    if fraction > WIDEST:
        return np.full_like(removed, np.nan)
    b, a = butter(settings.order, fraction)
    # The filter runs forwards and backwards, so its gain is the squared magnitude of one pass.
    gain = np.abs(freqz(b, a, FREQUENCIES)[1]) ** 2
    share = np.sqrt(np.mean(gain**2) / np.mean((1.0 - gain) ** 2))
    return np.asarray(share * removed)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Error of predicting the torque by an earlier measurement of the torque (persistence).

    Attributes:
        age_s: Median age of the earlier measurement [s]; the age varies because the samples are not
            exactly equidistant.
        error: (n,) RMSE of predicting the torque by the earlier measurement [N·m].
    """

    age_s: float
    error: FloatArray


def persistence_of(case: Case, latency_s: float) -> Held:
    """Return the error of predicting each torque by a torque that is `latency_s` [s] older.

    The predicted torque is the newest filtered torque whose age is at least `latency_s`.
    """
    error = persistence_rmse(case.judge, latency_s, "effort_f", case.rows)
    age = case.judge["t"] - persistence(case.judge, latency_s, "t")
    return Held(float(np.nanmedian(age[case.rows])), error * case.scale)
