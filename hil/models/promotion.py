"""Champion and challenger: compared on data that neither was fitted to; the better one is promoted.

The unit of the comparison is a block of 5 s, since errors of neighbouring samples are alike. So are
those of the same motion driven again, and blocks at the same place of a motion count once. Each
block has the difference of the two squared errors, per joint as a share of the champion's own;
Student's t over the blocks gives the 95 % interval of the mean (`Comparison`).

All data of one day share its room temperature and its warm-up: however many they are, they say
something about that day alone. With recordings of several days, each day counts once (`Days`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import (
    BoolArray,
    FloatArray,
    RegistryError,
    Rejected,
    Tone,
    card,
    number,
)
from hil.data import SAME_PLACE_RAD, SAME_SHARE, Dataset
from hil.estimators import RobotEstimator, student_quantile
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


@dataclass(frozen=True, slots=True)
class Decision:
    """The result of a challenge.

    Attributes:
        version: The challenger.
        instead_of: Champion it was compared with; None without one.
        promoted: Whether it is champion now.
        reason: Why, or why not.
        comparison: None without a champion.
        verdicts: Per source, on the criteria.
        days: The comparison over several days; None if there was no other day, or if the challenger
            had lost already.
    """

    version: ModelVersion
    instead_of: ModelVersion | None
    promoted: bool
    reason: str
    comparison: Comparison | None
    verdicts: tuple[Verdict, ...]
    days: Days | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil models promote --json`."""
        return {
            "name": self.version.name,
            "version": self.version.label,
            "instead_of": self.instead_of and self.instead_of.label,
            "promoted": self.promoted,
            "reason": self.reason,
        } | self.evidence

    @property
    def evidence(self) -> dict[str, Any]:
        """What the decision rests on, as the log has it."""
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
        name: Of the models.
        which: `challenger` or a version.
        sources: Recordings neither was fitted to.
        criteria: Every one has to be met on every source.
        unless_worse: Promote also if the difference is not significant and not for the worse.
        reason: Why the version was made; put before what the comparison says.
        earlier: Recordings of earlier days, one each, since when the robot has not changed: the
            challenger has to err less over all of these days, too.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to it.
        RegistryError: A version is missing or damaged, the data are too short, or another version
            became champion meanwhile.
    """
    version = registry.version(name, which)
    model = registry.load(name, version.label)
    number = registry.aliases(name).champion
    champion = registry.version(name, f"v{number}") if number else None
    parts = unseen_parts((model,), sources)
    verdicts = tuple(judge(evaluate(model, part), criteria) for part in parts)
    comparison = days = None
    if champion is not None and champion.number != version.number:
        old = registry.load(name, champion.label)
        comparison = compare_sources(old, model, sources)
    good, words = _decide(comparison, verdicts, unless_worse)
    if good and comparison is not None and earlier:
        days = over_days(old, model, [sources, *([source] for source in earlier)])
        good = days.less
        words += f", {days.words}" if good else f", but {days.words}: the robot is as it was"
    if good and version.number == number:
        words = "it was so before"
    reason = f"{reason}: {words}" if reason else words
    decision = Decision(version, champion, good, reason, comparison, verdicts, days)
    evidence = decision.evidence
    if good:
        registry.promote(name, version.number, reason=reason, evidence=evidence, instead_of=number)
    else:
        registry.keep(name, version.number, reason=reason, evidence=evidence)
    return decision


def _decide(
    comparison: Comparison | None, verdicts: Sequence[Verdict], unless_worse: bool
) -> tuple[bool, str]:
    """Return whether the challenger is to be promoted, and why."""
    missed = [row for verdict in verdicts for row in verdict.rows if not row.passed]
    if missed:
        row = missed[0]
        limit = f"{row.criterion.metric} of {row.what} is {row.value:.4g}"
        words = f"{len(missed)} criteria are missed: {limit}, at most {row.criterion.max:g}"
        return False, words
    if comparison is None:
        return True, "there is no other champion"
    good = comparison.better or (unless_worse and not comparison.worse)
    return good, comparison.words


def require_promoted(decision: Decision) -> None:
    """Raise if a challenger was not promoted, for command lines: a bad result, not a broken rig.

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

WORST_JOINT = 1.25
"""A joint whose RMSE grows by more than this factor keeps the champion, significant or not: there
may be too few data for significance."""

NOTICED = 1.05
"""A joint whose RMSE grows by more than this factor keeps the champion if that is significant."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two models on the same rows.

    Attributes:
        unit: Of the errors.
        joint_names: Length n.
        sources: What they were compared on.
        samples: Number of rows.
        blocks: Number of blocks of time, at distinct places of the motions.
        champion, challenger: (n,) RMSE against the filtered effort.
        difference: Mean over joints and blocks of the squared error's difference, as a share of the
            champion's squared error; negative where the challenger errs less.
        interval: 95 % interval of `difference`.
        surely_more: (n,) whether a joint errs more, with 95 % for all joints together.
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
        """Whether the challenger errs significantly less, and in no joint much more."""
        return self.interval[1] < 0.0 and not bool(np.any(self.spoilt))

    @property
    def worse(self) -> bool:
        """Whether the challenger errs more, significantly or not: it is never promoted then."""
        return self.difference > 0.0 or bool(np.any(self.spoilt))

    @property
    def spoilt(self) -> BoolArray:
        """(n,) whether a joint errs so much more that the other joints do not make up for it."""
        return (self.ratio > WORST_JOINT) | (self.surely_more & (self.ratio > NOTICED))

    @property
    def ratio(self) -> FloatArray:
        """(n,) ratio of the challenger's RMSE to the champion's."""
        return self.challenger / np.maximum(self.champion, np.finfo(np.float64).tiny)

    @property
    def words(self) -> str:
        """The result in one sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * self.difference:+.1f} % squared error ({low:+.1f} … {high:+.1f})"
        if self.better:
            return f"the challenger errs less: {spread}"
        if bool(np.any(self.spoilt)) and self.difference <= 0.0:
            j = int(np.argmax(np.where(self.spoilt, self.ratio, 0.0)))
            joint = f"{self.joint_names[j]} errs {self.ratio[j]:.2f} times as much"
            return f"{joint}, though in all {spread}"
        return f"the challenger errs {'more' if self.worse else 'no less that is sure'}: {spread}"

    def __repr__(self) -> str:
        return f"<Comparison on {self.samples} samples: {self.words}>"

    def _repr_html_(self) -> str:
        """Return the card for a notebook."""
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
        """Return the JSON form; part of the evidence of a promotion."""
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
    """Return the part of each source that the models work on and none was fitted to.

    From a run that one of the models was fitted to, these are the trajectories that were held out.

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
            require_unseen(model, source, data)  # without a fresh part it says which model knows it
        parts.append(data)
    return parts


def fresh_part(models: Sequence[RobotEstimator], data: Dataset) -> Dataset:
    """Return the series that no model was fitted to: whole ones, as their samples are alike."""

    def is_known(series: Dataset) -> bool:
        return any(seen_share(model, series) > SAME_SHARE for model in models)

    return data.take([i for i in range(len(data.conditions)) if not is_known(data.take([i]))])


BLOCK_S = 5.0
"""Duration that counts as one observation: errors stay alike for about as long [s]."""

FEWEST_BLOCKS = 4


def compare(
    champion: RobotEstimator,
    challenger: RobotEstimator,
    parts: Sequence[Dataset],
    sources: tuple[str, ...] = (),
) -> Comparison:
    """Compare two models on datasets; the caller has made sure that neither was fitted to them.

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
    # One-sided per joint and shared among the joints (Bonferroni), hence 2 and the division.
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
    """Return the squared errors of both, (N, n) each; NaN where one of them predicts nothing."""
    measured = filtered_effort(data)
    predictions = [model.predict(data) for model in (champion, challenger)]
    known = predictions[0].valid & predictions[1].valid & np.isfinite(measured)
    old, new = ((measured - one.effort) ** 2 for one in predictions)
    return np.where(known, old, np.nan), np.where(known, new, np.nan)


def _interval(shares: FloatArray, sure: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of blocks (B, m), and half the width of its interval: (m,) each."""
    count = len(shares)
    half = (
        student_quantile(0.5 + sure / 2, count - 1)
        * np.std(shares, axis=0, ddof=1)
        / np.sqrt(count)
    )
    return np.mean(shares, axis=0), np.asarray(half)


def blocks(
    data: Dataset, pair: tuple[FloatArray, FloatArray]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the (n,) mean position and the (2, n) mean squared errors of both models per block.

    No block reaches over the end of a series.
    """
    for _, rows in data.slices():
        if rows.stop <= rows.start:
            continue
        t = data["t"][rows]
        count = max(1, round(float(t[-1] - t[0]) / BLOCK_S))
        for piece in np.array_split(np.arange(rows.start, rows.stop), count):
            errors = np.stack([one[piece] for one in pair])
            if np.all(np.any(np.isfinite(errors), axis=1)):
                yield np.mean(data["q"][piece], axis=0), np.nanmean(errors, axis=1)


def by_place(blocks: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return the (B, 2, n) means of the blocks at each place, given position and errors of each."""
    places: list[FloatArray] = []
    errors_at: list[list[FloatArray]] = []
    for place, errors in blocks:
        near = [k for k, q in enumerate(places) if np.max(np.abs(q - place)) < SAME_PLACE_RAD]
        if near:
            errors_at[near[0]].append(errors)
        else:
            places.append(place)
            errors_at.append([errors])
    return np.array([np.mean(errors, axis=0) for errors in errors_at])


@dataclass(frozen=True, slots=True, eq=False)
class Days:
    """Two models on the same days.

    Attributes:
        differences: (D,) difference of the squared error per day, as a share of the champion's;
            negative where the challenger errs less.
        interval: 95 % interval of their mean.
    """

    differences: FloatArray
    interval: tuple[float, float]

    @property
    def less(self) -> bool:
        """Whether the challenger errs less, by more than the choice of days explains."""
        return self.interval[1] < 0.0

    @property
    def words(self) -> str:
        """The result in a few words."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * np.mean(self.differences):+.1f} % ({low:+.1f} … {high:+.1f})"
        return f"over {len(self.differences)} days {spread}"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form; part of the evidence of a promotion."""
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
        champion: The model in use.
        challenger: A model of the same joints and unit.
        days: Two at least; the recordings of each day, which neither was fitted to.

    Raises:
        DataError: A source cannot be read, or one of them was fitted to it.
        FitError: It holds nothing they work on.
    """
    differences = np.array([_difference(champion, challenger, sources) for sources in days])
    centre, half = (float(one[0]) for one in _interval(differences[:, None], SURE))
    return Days(differences, (centre - half, centre + half))


def _difference(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> float:
    """Return the difference of the squared error, the mean over joints and sources."""
    shares = []
    for part in unseen_parts((champion, challenger), sources):
        old, new = (evaluate(one, part).total.rmse_filtered for one in (champion, challenger))
        shares.append(np.mean(new**2 / np.maximum(old**2, np.finfo(np.float64).tiny)) - 1.0)
    return float(np.mean(shares))
