"""What a study of loads says in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hil.errors import HilError
from hil.study.load_score import TOLD, Scored, UnderLoads
from hil.study.load_tables import average
from hil.study.separation_text import listed, mean_of

TEXT = (
    "Models were fitted to the first load alone. Some motions are held out under every load; "
    "each other load is identified from the rest of its motions, and all errors are on those held "
    "out. Every model identifies loads for itself; the first checks the declarations.",
    "A declaration is contradicted where the identified load is further from it than noise, drive "
    "gains and the model's own errors explain. A joint whose gain is really larger makes every "
    "load too light: the loads that agree with one another tell by how much. With a single load, "
    "a wrong mass and wrong gains look alike, and limits are wider.",
)


def summary(found: Sequence[UnderLoads], false_alarm: float) -> tuple[str, ...]:
    """What to take away."""
    return (*_wrong(found[0].loads, false_alarm), *(_worst(model) for model in found))


def warnings(
    found: Sequence[UnderLoads], unfitted: Sequence[tuple[str, HilError]]
) -> tuple[str, ...]:
    """What could not be told."""
    checked = [one for one in found[0].loads if one.check]
    unseen = [o.case.name for o in checked if o.check and not o.check.mount_observable]
    failed = [f"{name}: {error.message}" for name, error in unfitted]
    failed += [
        f"{one.case.name}, {model.name}: not identified: {one.failed}"
        for model in found
        for one in model.loads
        if one.failed
    ]
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


def _worst(model: UnderLoads) -> str:
    bare, (worst, ratio) = model.loads[0], model.worst()
    words = {"declared": f"declared ({ratio:.2f} times that of {bare.case.name})"}
    each = [(words.get(told, told), average(worst, told)) for told in TOLD]
    figures = [f"{number:.3g} N·m {told}" for told, number in each if number is not None]
    return (
        f"{model.name}, mean over the joints: {mean_of(bare.errors['declared']):.3g} N·m with "
        f"{bare.case.name}; at worst, with {worst.case.name}, {listed(figures)}."
    )
