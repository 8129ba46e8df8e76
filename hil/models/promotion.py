"""From challenger to champion: only what errs less on held-out data, and meets criteria."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import Rejected
from hil.evaluation import Criterion, Verdict, evaluate, judge
from hil.models.compare import Comparison, compare_sources, unseen_parts
from hil.models.days import Days, over_days
from hil.models.model_registry import Registry
from hil.models.version import ModelVersion


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
