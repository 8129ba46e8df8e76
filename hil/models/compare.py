"""Two models on the same data: which one errs less, and is that more than chance?

Errors of neighbouring samples are alike, so data count by blocks of time; so are those of the same
motion driven again, so that blocks of one place of it count once. Each says by how much the
challenger's squared error differs from the champion's, every joint as a share of the champion's
own; Student's t of the blocks says what the difference may be with 95 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from hil.core import BoolArray, FloatArray, RegistryError, Tone, card, number
from hil.data import SAME_SHARE, Dataset
from hil.estimators import RobotEstimator
from hil.evaluation import filtered_effort, require_unseen, seen_share, usable_part
from hil.importers import load_source
from hil.models.blocks import BLOCK_S, blocks, by_place

SURE = 0.95
FEWEST_BLOCKS = 4

NOTICED = 1.05
"""A joint that errs for sure, and more than so many times what it did, keeps the champion."""

WORST_JOINT = 1.25
"""So does one that errs more than so many times what it did, sure or not: data may be few."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two models on the same rows.

    Attributes:
        unit: Of the errors.
        joint_names: Length n.
        sources: What they were compared on.
        samples: Rows.
        blocks: Of time, at distinct places of the motions.
        champion, challenger: (n,) RMSE against the filtered effort.
        difference: Mean over joints and blocks of the squared error's difference, as a share of the
            champion's squared error; negative where the challenger errs less.
        interval: Of that, with 95 %.
        surely_more: (n,) whether a joint errs more, of all joints together with 95 %.
    """

    unit: str
    joint_names: tuple[str, ...]
    sources: tuple[str, ...]
    samples: int
    blocks: int
    champion: FloatArray
    challenger: FloatArray
    difference: float
    interval: tuple[float, float]
    surely_more: BoolArray

    @property
    def better(self) -> bool:
        """The challenger errs less for sure, and in no joint clearly more."""
        return self.interval[1] < 0.0 and not bool(np.any(self.spoilt))

    @property
    def worse(self) -> bool:
        """The challenger errs more, by whatever: such a one is never promoted."""
        return self.difference > 0.0 or bool(np.any(self.spoilt))

    @property
    def spoilt(self) -> BoolArray:
        """(n,) joints that err so much more that the others do not make up for it."""
        return (self.ratio > WORST_JOINT) | (self.surely_more & (self.ratio > NOTICED))

    @property
    def ratio(self) -> FloatArray:
        """(n,) of the challenger's RMSE to the champion's."""
        least = np.finfo(np.float64).tiny
        found: FloatArray = self.challenger / np.maximum(self.champion, least)
        return found

    @property
    def words(self) -> str:
        """One sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * self.difference:+.1f} % squared error ({low:+.1f} … {high:+.1f})"
        if self.better:
            return f"the challenger errs less: {spread}"
        if bool(np.any(self.spoilt)) and self.difference <= 0.0:
            j = int(np.argmax(np.where(self.spoilt, self.ratio, 0.0)))
            told = f"{self.joint_names[j]} errs {self.ratio[j]:.2f} times as much"
            return f"{told}, though in all {spread}"
        return f"the challenger errs {'more' if self.worse else 'no less that is sure'}: {spread}"

    def __repr__(self) -> str:
        return f"<Comparison on {self.samples} samples: {self.words}>"

    def _repr_html_(self) -> str:
        """Itself in a notebook."""
        badge: tuple[str, Tone] = ("not better for sure", "warn")
        if self.better or self.worse:
            badge = ("better", "pass") if self.better else ("worse", "fail")
        rows = [
            (f"champion [{self.unit}]", *map(number, self.champion)),
            (f"challenger [{self.unit}]", *map(number, self.challenger)),
            ("times as much", *(f"{one:.2f}" for one in self.ratio)),
        ]
        facts = {"samples": f"{self.samples:,}", "blocks of time": self.blocks}
        head = ("RMSE", *self.joint_names)
        return card(
            "Comparison", self.words, facts, badge=badge, table=(head, rows), notes=self.sources
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON form; the evidence of a promotion."""
        return {
            "unit": self.unit,
            "joint_names": list(self.joint_names),
            "sources": list(self.sources),
            "samples": self.samples,
            "blocks": self.blocks,
            "champion_rmse": self.champion.tolist(),
            "challenger_rmse": self.challenger.tolist(),
            "difference": self.difference,
            "interval_95": list(self.interval),
            "surely_more": self.surely_more.tolist(),
            "better": self.better,
            "worse": self.worse,
            "words": self.words,
        }


def compare_sources(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> Comparison:
    """Compare two models on recordings neither was fitted to.

    Raises:
        DataError: A source cannot be read, or one of them was fitted to it.
        FitError: It holds nothing they work on.
        RegistryError: They are of different joints or units, or the data are too short.
    """
    parts = unseen_parts((champion, challenger), sources)
    return compare(champion, challenger, parts, tuple(str(source) for source in sources))


def unseen_parts(models: Sequence[RobotEstimator], sources: Sequence[Path]) -> list[Dataset]:
    """What of each source the models work on and none was fitted to.

    Of a run that one of them comes from these are the trajectories that were held out.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to all of it.
        FitError: It holds nothing the first of them works on.
    """
    parts = []
    for source in sources:
        data = usable_part(load_source(source), models[0])
        if len(fresh := fresh_part(models, data)):
            data = fresh
        for model in models:
            require_unseen(model, source, data)
        parts.append(data)
    return parts


def fresh_part(models: Sequence[RobotEstimator], data: Dataset) -> Dataset:
    """The series that no model knows; whole ones, since neighbouring samples are alike."""
    fresh = [i for i in range(len(data.conditions)) if not _knows(models, data.take([i]))]
    return data.take(fresh)


def _knows(models: Sequence[RobotEstimator], series: Dataset) -> bool:
    return any(seen_share(model, series) > SAME_SHARE for model in models)


def compare(
    champion: RobotEstimator,
    challenger: RobotEstimator,
    parts: Sequence[Dataset],
    sources: tuple[str, ...] = (),
) -> Comparison:
    """The same on datasets; that nothing of them was learned is the caller's affair.

    Raises:
        DataError: They are not of the models' robot.
        RegistryError: As `compare_sources`.
    """
    _require_alike(champion, challenger)
    errors = [_squared(champion, challenger, data) for data in parts]
    means = by_place(
        [block for data, pair in zip(parts, errors, strict=True) for block in blocks(data, pair)]
    )
    if len(means) < FEWEST_BLOCKS:
        raise RegistryError(
            f"there are only {len(means)} distinct blocks of {BLOCK_S:.0f} s to compare on",
            hint=f"give recordings of different motions, {FEWEST_BLOCKS * BLOCK_S:.0f} s at least",
        )
    both = np.concatenate([np.stack(pair, axis=1) for pair in errors])
    old, new = np.sqrt(np.nanmean(both, axis=0))
    shares = (means[:, 1] - means[:, 0]) / np.maximum(old, np.finfo(float).tiny) ** 2
    each, margin = _interval(shares, 1.0 - 2.0 * (1.0 - SURE) / shares.shape[1])
    centre, half = (float(one[0]) for one in _interval(shares.mean(axis=1, keepdims=True), SURE))
    data = parts[0]
    return Comparison(
        data.effort_unit, data.joint_names, sources, int(np.sum(np.isfinite(both[:, 0, 0]))),
        len(shares), old, new, centre, (centre - half, centre + half), each - margin > 0.0,
    )  # fmt: skip


def _interval(shares: FloatArray, sure: float) -> tuple[FloatArray, FloatArray]:
    """Mean of the blocks (B, m), and half the width of its interval: (m,) each."""
    count = len(shares)
    half = student.ppf(0.5 + sure / 2, count - 1) * np.std(shares, axis=0, ddof=1) / np.sqrt(count)
    return np.mean(shares, axis=0), np.asarray(half)


def _squared(
    champion: RobotEstimator, challenger: RobotEstimator, data: Dataset
) -> tuple[FloatArray, FloatArray]:
    """(N, n) squared errors of both, NaN where one of them says nothing."""
    measured = filtered_effort(data)
    predictions = [model.predict(data) for model in (champion, challenger)]
    known = predictions[0].valid & predictions[1].valid & np.isfinite(measured)
    old, new = ((measured - one.effort) ** 2 for one in predictions)
    return np.where(known, old, np.nan), np.where(known, new, np.nan)


def _require_alike(champion: RobotEstimator, challenger: RobotEstimator) -> None:
    for what in ("joint_names_", "effort_kind_"):
        old, new = getattr(champion, what), getattr(challenger, what)
        if old != new:
            raise RegistryError(
                f"the champion's {what.strip('_').replace('_', ' ')} are {old}, "
                f"the challenger's {new}",
                hint="models of different robots belong under different names",
            )
