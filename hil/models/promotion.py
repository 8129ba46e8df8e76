"""Comparison of challenger and champion on unseen data, and promotion of the better model.

The comparison is based on blocks of 5 s instead of samples, because the errors of neighbouring
samples are correlated. The prediction errors of repetitions of the same motion are correlated, too,
so all blocks at the same place of a motion count as one observation. Each block yields, per joint,
the difference of the squared errors of the two models as a share of the champion's squared error.
Student's t distribution over the blocks yields the 95 % confidence interval of the mean difference
(`Comparison`).

All data of one day share the same room temperature and the same warm-up. Any amount of data of one
day is evidence about that day only. With recordings of several days, each day counts as one
observation (`Days`).
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
    """Result of a challenge.

    Attributes:
        version: Challenger.
        instead_of: Champion with which the challenger was compared; None if there was no champion.
        promoted: Flag; true if the challenger became the champion.
        reason: Reason for or against the promotion in words.
        comparison: Comparison of challenger and champion; None if there was no champion.
        verdicts: Verdict on the criteria for each data source.
        days: Comparison over several days; None if there was no other day, or if the challenger had
            been rejected before.
    """

    version: ModelVersion
    instead_of: ModelVersion | None
    promoted: bool
    reason: str
    comparison: Comparison | None
    verdicts: tuple[Verdict, ...]
    days: Days | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the documented output of `hil models promote --json`."""
        return {
            "name": self.version.name,
            "version": self.version.label,
            "instead_of": self.instead_of and self.instead_of.label,
            "promoted": self.promoted,
            "reason": self.reason,
        } | self.evidence

    @property
    def evidence(self) -> dict[str, Any]:
        """Evidence of the decision, as stored in the log."""
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
    """Compare a version with the champion; promote the version, or log why not.

    Args:
        registry: Registry that contains the version and the champion.
        name: Name of the model.
        which: Version to compare: `challenger` or a version number.
        sources: Recordings to which neither the version nor the champion was fitted.
        criteria: Criteria that the version must meet on every source.
        unless_worse: Flag; if true, the version is also promoted if the difference is not
            significant and not to its disadvantage.
        reason: Reason for which the version was created; the log entry begins with this reason,
            followed by the result of the comparison.
        earlier: Recordings of earlier days, one per day; the robot must not have changed since
            these days. The challenger must also have the smaller error over all days together.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to it.
        RegistryError: The version is missing or damaged, the data are too short, or a different
            version became champion meanwhile.
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
        words += (
            f", {days.words}" if good else f", but {days.words}, although the robot is unchanged"
        )
    if good and version.number == number:
        words = "it was champion already"
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
    """Return whether the challenger is promoted, and the reason."""
    missed = [row for verdict in verdicts for row in verdict.rows if not row.passed]
    if missed:
        row = missed[0]
        limit = f"{row.criterion.metric} of {row.what} is {row.value:.4g}"
        words = f"{len(missed)} criteria are not met: {limit}, at most {row.criterion.max:g}"
        return False, words
    if comparison is None:
        return True, "there is no other champion"
    good = comparison.better or (unless_worse and not comparison.worse)
    return good, comparison.words


def require_promoted(decision: Decision) -> None:
    """Raise `Rejected` if a challenger was not promoted, for command lines.

    `Rejected` reports a negative result of the comparison, whereas other errors report a failure.

    Raises:
        Rejected: The challenger was not promoted.
    """
    if not decision.promoted:
        old = decision.instead_of
        stays = f"{old.label} stays champion" if old else "there is no champion yet"
        raise Rejected(
            f"{decision.version.name} {decision.version.label} is not promoted, {stays}: "
            f"{decision.reason}",
            hint="it stays in the registry; compare it on more data: hil models compare",
        )


SURE = 0.95

WORST_JOINT = 1.25
"""Maximum allowed ratio of the challenger's to the champion's RMSE in a joint, whether the increase
is significant or not. Above the maximum allowed ratio of a joint the champion stays, because the
data may be too few to show significance.
"""

NOTICED = 1.05
"""Maximum allowed ratio of the challenger's to the champion's RMSE in a joint if the increase is
significant. Above the maximum ratio for a significant increase the champion stays.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Comparison of two models on the same samples.

    Attributes:
        unit: Unit of the prediction errors.
        joint_names: Names of the n joints.
        sources: Data sources of the samples.
        samples: Number of compared samples.
        blocks: Number of time blocks, each at a distinct place of the motions.
        champion, challenger: (n,) RMSE of each model with respect to the filtered effort.
        difference: Squared error of the challenger minus that of the champion, as a share of the
            champion's squared error; mean over joints and blocks. `difference` is negative if the
            challenger has the smaller error.
        interval: 95 % confidence interval of `difference`.
        surely_more: (n,) flags; true if the challenger's error in a joint is larger, with 95 %
            confidence for all joints together.
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
        """Whether the challenger's error is significantly smaller, and much larger in no joint."""
        return self.interval[1] < 0.0 and not bool(np.any(self.spoilt))

    @property
    def worse(self) -> bool:
        """Whether the challenger's error is larger, significantly or not; excludes a promotion."""
        return self.difference > 0.0 or bool(np.any(self.spoilt))

    @property
    def spoilt(self) -> BoolArray:
        """Whether the error of each joint increases too much for a promotion, (n,)."""
        return (self.ratio > WORST_JOINT) | (self.surely_more & (self.ratio > NOTICED))

    @property
    def ratio(self) -> FloatArray:
        """Ratio (n,) of the challenger's RMSE to the champion's RMSE."""
        return self.challenger / np.maximum(self.champion, np.finfo(np.float64).tiny)

    @property
    def words(self) -> str:
        """Result of the comparison in one sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * self.difference:+.1f} % squared error ({low:+.1f} … {high:+.1f})"
        if self.better:
            return f"the challenger's error is smaller: {spread}"
        if bool(np.any(self.spoilt)) and self.difference <= 0.0:
            j = int(np.argmax(np.where(self.spoilt, self.ratio, 0.0)))
            joint = f"the error of {self.joint_names[j]} is {self.ratio[j]:.2f} times as large"
            return f"{joint}, although in total {spread}"
        if self.worse:
            return f"the challenger's error is larger: {spread}"
        return f"the challenger's error is not significantly smaller: {spread}"

    def __repr__(self) -> str:
        return f"<Comparison on {self.samples} samples: {self.words}>"

    def _repr_html_(self) -> str:
        """Return the notebook card of the comparison."""
        badge: tuple[str, Tone] = ("not significantly better", "warn")
        if self.better or self.worse:
            badge = ("better", "pass") if self.better else ("worse", "fail")
        rows = [
            (f"champion [{self.unit}]", *map(number, self.champion)),
            (f"challenger [{self.unit}]", *map(number, self.challenger)),
            ("ratio", *(f"{one:.2f}" for one in self.ratio)),
        ]
        facts = {"samples": f"{self.samples:,}", "blocks of time": self.blocks}
        head = ("RMSE", *self.joint_names)
        return card(
            "Comparison", self.words, facts, badge=badge, table=(head, rows), notes=self.sources
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a JSON object, which is part of the evidence of a promotion."""
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
    """Compare two models on recordings to which neither model was fitted.

    Raises:
        DataError: A source cannot be read, or one of the two models was fitted to it.
        FitError: A source contains no data that are usable for the models.
        RegistryError: The models have different joints or units, or the data are too short.
    """
    parts = unseen_parts((champion, challenger), sources)
    return compare(champion, challenger, parts, tuple(str(source) for source in sources))


def unseen_parts(models: Sequence[RobotEstimator], sources: Sequence[Path]) -> list[Dataset]:
    """Return the usable part of each source, to which none of the models was fitted.

    The usable part of a run to which one of the models was fitted is its hold-out set.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to the whole source.
        FitError: A source contains no data that are usable for the first model.
    """
    parts = []
    for source in sources:
        data = usable_part(load_source(source), models[0])
        if len(fresh := fresh_part(models, data)):
            data = fresh
        for model in models:
            require_unseen(model, source, data)  # raises without an unseen part
        parts.append(data)
    return parts


def fresh_part(models: Sequence[RobotEstimator], data: Dataset) -> Dataset:
    """Return the series of a dataset to which no model was fitted.

    Only whole series are returned, because the samples of one series are correlated.
    """

    def is_known(series: Dataset) -> bool:
        return any(seen_share(model, series) > SAME_SHARE for model in models)

    return data.take([i for i in range(len(data.conditions)) if not is_known(data.take([i]))])


BLOCK_S = 5.0
"""Duration of a block that counts as one observation [s]; prediction errors are correlated for
about this time.
"""

FEWEST_BLOCKS = 4


def compare(
    champion: RobotEstimator,
    challenger: RobotEstimator,
    parts: Sequence[Dataset],
    sources: tuple[str, ...] = (),
) -> Comparison:
    """Compare two models on datasets; the caller must ensure that neither model was fitted to them.

    Raises:
        DataError: The datasets belong to a different robot than the two models.
        RegistryError: The models have different joints or units, or the data are too short.
    """
    _require_alike(champion, challenger)
    errors = [_squared(champion, challenger, data) for data in parts]
    means = by_place(
        [block for data, pair in zip(parts, errors, strict=True) for block in blocks(data, pair)]
    )
    if len(means) < FEWEST_BLOCKS:
        raise RegistryError(
            f"only {len(means)} distinct blocks of {BLOCK_S:.0f} s are available for comparison",
            hint=f"give recordings of different motions, at least {FEWEST_BLOCKS * BLOCK_S:.0f} s",
        )
    both = np.concatenate([np.stack(pair, axis=1) for pair in errors])
    old, new = np.sqrt(np.nanmean(both, axis=0))
    shares = (means[:, 1] - means[:, 0]) / np.maximum(old, np.finfo(float).tiny) ** 2
    # One-sided test, hence the factor 2; all joints share the level (Bonferroni).
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
                f"champion and challenger differ in {what.strip('_').replace('_', ' ')}: "
                f"{old} and {new}",
                hint="register models of different robots under different names",
            )


def _squared(
    champion: RobotEstimator, challenger: RobotEstimator, data: Dataset
) -> tuple[FloatArray, FloatArray]:
    """Return the squared errors of the two models, (N, n) each; NaN if one has no prediction."""
    measured = filtered_effort(data)
    predictions = [model.predict(data) for model in (champion, challenger)]
    known = predictions[0].valid & predictions[1].valid & np.isfinite(measured)
    old, new = ((measured - one.effort) ** 2 for one in predictions)
    return np.where(known, old, np.nan), np.where(known, new, np.nan)


def _interval(shares: FloatArray, sure: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of blocks (B, m) and the half-width of its confidence interval, (m,) each."""
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
    """Yield mean position (n,) and mean squared errors of the two models (2, n) for each block.

    No block extends beyond the end of a series.
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
    """Return the mean errors (B, 2, n) over all blocks at each place of the motion.

    Args:
        blocks: Mean position and mean squared errors of each block.
    """
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
    """Comparison of two models on the recordings of the same days.

    Attributes:
        differences: (D,) squared error of the challenger minus that of the champion for each day,
            as a share of the champion's squared error; negative if the challenger has the smaller
            error.
        interval: 95 % confidence interval of the mean difference.
    """

    differences: FloatArray
    interval: tuple[float, float]

    @property
    def less(self) -> bool:
        """Whether the challenger's error is smaller by more than the scatter between the days."""
        return self.interval[1] < 0.0

    @property
    def words(self) -> str:
        """Result of the comparison over several days in a few words."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * np.mean(self.differences):+.1f} % ({low:+.1f} … {high:+.1f})"
        return f"over {len(self.differences)} days {spread}"

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison over days as a JSON object, part of the evidence of a promotion."""
        return {
            "differences": self.differences.tolist(),
            "interval_95": list(self.interval),
            "less": self.less,
        }


def over_days(
    champion: RobotEstimator, challenger: RobotEstimator, days: Sequence[Sequence[Path]]
) -> Days:
    """Compare two models day by day on recordings of several days.

    Args:
        champion: Model in use.
        challenger: Model with the same joints and unit as the champion.
        days: Recordings of each day, to which neither model was fitted; at least two days are
            required.

    Raises:
        DataError: A source cannot be read, or one of the two models was fitted to it.
        FitError: A source contains no data that are usable for the models.
    """
    differences = np.array([_difference(champion, challenger, sources) for sources in days])
    centre, half = (float(one[0]) for one in _interval(differences[:, None], SURE))
    return Days(differences, (centre - half, centre + half))


def _difference(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> float:
    """Return the relative difference of the squared errors, averaged over joints and sources."""
    shares = []
    for part in unseen_parts((champion, challenger), sources):
        old, new = (evaluate(one, part).total.rmse_filtered for one in (champion, challenger))
        shares.append(np.mean(new**2 / np.maximum(old**2, np.finfo(np.float64).tiny)) - 1.0)
    return float(np.mean(shares))
