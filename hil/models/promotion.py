"""Champion and challenger: compared on data neither was fitted to, and promoted if that is sure.

Errors of neighbouring samples are alike, so data count by blocks of time; so are those of the same
motion driven again, so that blocks of one place of it count once. Each says by how much the
challenger's squared error differs from the champion's, every joint as a share of the champion's
own; Student's t of the blocks says what the difference may be with 95 % (`Comparison`).

All data of one day share its room and its warmth: however many they are, they are sure of that day
alone. Where there are several days, a day counts once (`Days`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from hil.core import BoolArray, FloatArray, RegistryError, Rejected, Tone, card, number
from hil.data import SAME_PLACE_RAD, SAME_SHARE, Dataset
from hil.estimators import RobotEstimator
from hil.evaluation import (
    Criterion,
    Verdict,
    evaluate,
    filtered_effort,
    judge,
    require_unseen,
    seen_share,
    usable_part,
)
from hil.importers import load_source
from hil.models.model_registry import Registry
from hil.models.version import ModelVersion

WORST_JOINT = 1.25
"""So does one that errs more than so many times what it did, sure or not: data may be few."""

NOTICED = 1.05
"""A joint that errs for sure, and more than so many times what it did, keeps the champion."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What came of a challenge.

    Attributes:
        version: That was to be promoted.
        instead_of: Champion it was compared with; None where there was none.
        promoted: Whether it is champion now.
        reason: Why, or why not.
        comparison: None without a champion.
        verdicts: Per source, on the criteria.
        days: The comparison with earlier days; None where there were none, or no need to look.
    """

    version: ModelVersion
    instead_of: ModelVersion | None
    promoted: bool
    reason: str
    comparison: Comparison | None
    verdicts: tuple[Verdict, ...]
    days: Days | None = None

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil models promote --json`."""
        return {
            "name": self.version.name,
            "version": self.version.label,
            "instead_of": self.instead_of and self.instead_of.label,
            "promoted": self.promoted,
            "reason": self.reason,
        } | self.evidence

    @property
    def evidence(self) -> dict[str, Any]:
        """What it rests on."""
        return {
            "comparison": self.comparison and self.comparison.to_dict(),
            "criteria": [verdict.to_dict() for verdict in self.verdicts],
        } | ({"days": self.days.to_dict()} if self.days else {})


def challenge(
    registry: Registry,
    name: str,
    which: str,
    sources: Sequence[Path],
    *,
    criteria: Sequence[Criterion] = (),
    unless_worse: bool = False,
    reason: str = "",
    earlier: Sequence[Path] = (),
) -> Decision:
    """Compare a version with the champion; promote it, or note why not.

    Args:
        registry: Where both are.
        name: Whose.
        which: `challenger` or a version.
        sources: Recordings neither has seen.
        criteria: Every one has to be met on every source.
        unless_worse: Promote also what errs neither less for sure nor more.
        reason: Why somebody wants it; put before what the comparison says.
        earlier: Recordings of days before, one each, since when the robot has not changed: it is
            to err less on these days, too.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to it.
        RegistryError: A version is missing or damaged, the data are too short, or another champion
            was made meanwhile.
    """
    version = registry.version(name, which)
    model = registry.load(name, version.label)
    number = registry.aliases(name).champion
    champion = registry.version(name, f"v{number}") if number else None
    parts = unseen_parts((model,), sources)
    verdicts = tuple(judge(evaluate(model, part), criteria) for part in parts)
    compared = days = None
    if champion is not None and champion.number != version.number:
        old = registry.load(name, champion.label)
        compared = compare_sources(old, model, sources)
    good, words = _decide(compared, verdicts, unless_worse)
    if good and compared is not None and earlier:
        days = over_days(old, model, [sources, *([source] for source in earlier)])
        good = days.less
        words += f", {days.words}" if good else f", but {days.words}: the robot is as it was"
    if good and version.number == number:
        words = "it was so before"
    told = f"{reason}: {words}" if reason else words
    decision = Decision(version, champion, good, told, compared, verdicts, days)
    evidence = decision.evidence
    if good:
        registry.promote(name, version.number, reason=told, evidence=evidence, instead_of=number)
    else:
        registry.keep(name, version.number, reason=told, evidence=evidence)
    return decision


def _decide(
    compared: Comparison | None, verdicts: Sequence[Verdict], unless_worse: bool
) -> tuple[bool, str]:
    missed = [row for verdict in verdicts for row in verdict.rows if not row.passed]
    if missed:
        row = missed[0]
        limit = f"{row.criterion.metric} of {row.what} is {row.value:.4g}"
        words = f"{len(missed)} criteria are missed: {limit}, at most {row.criterion.max:g}"
        return False, words
    if compared is None:
        return True, "there is no other champion"
    good = compared.better or (unless_worse and not compared.worse)
    return good, compared.words


def require_promoted(decision: Decision) -> None:
    """For command lines: a challenger that was not promoted is a bad result, not a fault.

    Raises:
        Rejected: It was not.
    """
    if not decision.promoted:
        stays = decision.instead_of.label if decision.instead_of else "no champion"
        raise Rejected(
            f"{decision.version.name} {decision.version.label} is not promoted, {stays} stays: "
            f"{decision.reason}",
            hint="it stays in the registry; compare it on more data with: hil models compare",
        )


SURE = 0.95

FEWEST_BLOCKS = 4


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


BLOCK_S = 5.0
"""Of time that counts as one observation; friction and load keep errors alike for about as long."""


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


def _require_alike(champion: RobotEstimator, challenger: RobotEstimator) -> None:
    for what in ("joint_names_", "effort_kind_"):
        old, new = getattr(champion, what), getattr(challenger, what)
        if old != new:
            raise RegistryError(
                f"the champion's {what.strip('_').replace('_', ' ')} are {old}, "
                f"the challenger's {new}",
                hint="models of different robots belong under different names",
            )


def _squared(
    champion: RobotEstimator, challenger: RobotEstimator, data: Dataset
) -> tuple[FloatArray, FloatArray]:
    """(N, n) squared errors of both, NaN where one of them says nothing."""
    measured = filtered_effort(data)
    predictions = [model.predict(data) for model in (champion, challenger)]
    known = predictions[0].valid & predictions[1].valid & np.isfinite(measured)
    old, new = ((measured - one.effort) ** 2 for one in predictions)
    return np.where(known, old, np.nan), np.where(known, new, np.nan)


def _interval(shares: FloatArray, sure: float) -> tuple[FloatArray, FloatArray]:
    """Mean of the blocks (B, m), and half the width of its interval: (m,) each."""
    count = len(shares)
    half = student.ppf(0.5 + sure / 2, count - 1) * np.std(shares, axis=0, ddof=1) / np.sqrt(count)
    return np.mean(shares, axis=0), np.asarray(half)


def blocks(
    data: Dataset, pair: tuple[FloatArray, FloatArray]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Where, (n,) mean positions, and (2, n) mean squared errors of both models, block by block.

    Series are never joined.
    """
    for _, rows in data.slices():
        if rows.stop <= rows.start:
            continue
        t = data["t"][rows]
        count = max(1, round(float(t[-1] - t[0]) / BLOCK_S))
        for piece in np.array_split(np.arange(rows.start, rows.stop), count):
            found = np.stack([one[piece] for one in pair])
            if np.all(np.any(np.isfinite(found), axis=1)):
                yield np.mean(data["q"][piece], axis=0), np.nanmean(found, axis=1)


def by_place(found: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """(B, 2, n) means of the blocks at each place."""
    where: list[FloatArray] = []
    there: list[list[FloatArray]] = []
    for place, errors in found:
        near = [k for k, q in enumerate(where) if np.max(np.abs(q - place)) < SAME_PLACE_RAD]
        if near:
            there[near[0]].append(errors)
        else:
            where.append(place)
            there.append([errors])
    return np.array([np.mean(errors, axis=0) for errors in there])


@dataclass(frozen=True, slots=True, eq=False)
class Days:
    """Two models on the same days.

    Attributes:
        differences: (D,) of the squared error, per day, as a share of the champion's; negative
            where the challenger errs less.
        interval: Of their mean, with 95 %.
    """

    differences: FloatArray
    interval: tuple[float, float]

    @property
    def less(self) -> bool:
        """The challenger errs less, and that is more than the choice of days."""
        return self.interval[1] < 0.0

    @property
    def words(self) -> str:
        """One sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * np.mean(self.differences):+.1f} % ({low:+.1f} … {high:+.1f})"
        return f"over {len(self.differences)} days {spread}"

    def to_dict(self) -> dict[str, Any]:
        """JSON form; a part of the evidence of a promotion."""
        return {
            "differences": self.differences.tolist(),
            "interval_95": list(self.interval),
            "less": self.less,
        }


def over_days(
    champion: RobotEstimator, challenger: RobotEstimator, days: Sequence[Sequence[Path]]
) -> Days:
    """Compare two models day by day.

    Args:
        champion: In use.
        challenger: Of the same joints and unit.
        days: Two at least; of each the recordings, which neither was fitted to.

    Raises:
        DataError: A source cannot be read, or one of them was fitted to it.
        FitError: It holds nothing they work on.
    """
    found = np.array([_difference(champion, challenger, sources) for sources in days])
    count = len(found)
    half = student.ppf(0.5 + SURE / 2, count - 1) * np.std(found, ddof=1) / np.sqrt(count)
    centre = float(np.mean(found))
    return Days(found, (centre - float(half), centre + float(half)))


def _difference(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> float:
    """Mean over joints and sources."""
    shares = []
    for part in unseen_parts((champion, challenger), sources):
        old, new = (evaluate(one, part).total.rmse_filtered for one in (champion, challenger))
        shares.append(np.mean(new**2 / np.maximum(old**2, np.finfo(np.float64).tiny)) - 1.0)
    return float(np.mean(shares))
