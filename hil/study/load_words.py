"""What a study of loads says in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hil.study.load_score import Scored
from hil.study.load_tables import average
from hil.study.separation_text import listed

TEXT = (
    "The model was fitted to the first load alone. Some motions are held out under every load; "
    "each other load is identified from the rest of its motions, and all errors are on those held "
    "out.",
    "A declaration is contradicted where the identified load is further from it than noise, drive "
    "gains and the model's own errors explain. A joint whose gain is really larger makes every "
    "load too light: the loads that agree with one another tell by how much. With a single load, "
    "a wrong mass and wrong gains look alike, and limits are wider.",
)


def summary(found: Sequence[Scored], estimator: str, false_alarm: float) -> tuple[str, ...]:
    """What to take away."""
    return (*_wrong(found, false_alarm), *_errors(found, estimator))


def warnings(found: Sequence[Scored]) -> tuple[str, ...]:
    """What could not be told."""
    unseen = [o.case.name for o in found if o.check and not o.check.mount_observable]
    failed = [f"{o.case.name}: not identified: {o.failed}" for o in found if o.failed]
    checked = [one for one in found if one.check]
    if unseen:
        failed.append(
            f"{listed(unseen)}: the centre of mass lies on the flange's axis, so that the angle at "
            "which it is mounted cannot be observed"
        )
    if len(checked) == 2 and not all(one.check and one.check.agrees for one in checked):
        failed.append("two loads contradict each other: which is wrong is a guess; record a third")
    return tuple(failed)


def _wrong(found: Sequence[Scored], false_alarm: float) -> Iterator[str]:
    checked = [one for one in found if one.check]
    wrong = [one for one in checked if one.check and not one.check.agrees]
    for one in wrong:
        told = one.check.findings if one.check else ()
        yield f"{one.case.name}: {'; '.join(finding.text for finding in told)}."
    rest = f"Of correct ones at most {100 * false_alarm:.2g} % would be called wrong."
    if checked and not wrong:
        yield f"All {len(checked)} declared loads agree with those identified. {rest}"
    elif checked:
        yield f"{len(wrong)} of {len(checked)} declared loads are contradicted. {rest}"


def _errors(found: Sequence[Scored], estimator: str) -> Iterator[str]:
    for one in found:
        if one.case.told is None:
            continue
        each = [(told, average(one, told)) for told in ("unaware", "declared", "identified")]
        figures = [f"{number:.3g} N·m {told}" for told, number in each if number is not None]
        yield f"{one.case.name}, {estimator}, mean over the joints: {listed(figures)}."
