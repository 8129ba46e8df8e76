"""What a study of loads says in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import HilError
from hil.estimators import Declaration
from hil.studies.load_score import TOLD, Scored, UnderLoads
from hil.studies.load_tables import average
from hil.studies.separation_text import listed, mean_of

ALIKE = 1.5
"""Errors of masses that differ by no more than this factor are one error, made with every load."""

BEYOND = 0.5
"""Share of its limit from which an error that all loads share is worth a word."""

ABOVE = 1.25
"""Times by which an error told of a load as declared is above that as identified, to be told."""

TEXT = (
    "Models were fitted to the first load alone. Motions are held out under every load, and each "
    "load is identified from the other motions with it. Every motion is judged once, by a model "
    "fitted to the others, and errors are over all of them. Every model identifies loads for "
    "itself; the first, as fitted without the first motions that were judged, checks the "
    "declarations.",
    "A declaration is contradicted where the identified load is further from it than noise, drive "
    "gains and the model's own errors explain. A joint whose gain is really larger makes every "
    "load too light: the loads that agree with one another tell by how much. With a single load, "
    "a wrong mass and wrong gains look alike, and limits are wider.",
)


def title(found: Sequence[UnderLoads], models: Sequence[str]) -> str:
    """Which models the study is of: those of the run, stored elsewhere, or its own fits."""
    names = listed([one.name for one in found])
    if not models:
        return f"Under loads: {names}, fitted for this study, and the loads as declared"
    if all(model.startswith("fit/") for model in models):
        return f"Under loads: {names}, models of this run, and the loads as declared"
    return f"Under loads: {names}, stored in {listed(models)}, and the loads as declared"


def summary(found: Sequence[UnderLoads], false_alarm: float) -> tuple[str, ...]:
    """What to take away."""
    return (*_wrong(found[0].loads, false_alarm), *(_worst(model) for model in found))


def warnings(
    found: Sequence[UnderLoads], unfitted: Sequence[tuple[str, HilError]]
) -> tuple[str, ...]:
    """What could not be told."""
    checked = [(one, one.check) for one in found[0].loads if one.check]
    told = [f"{name}: {error.message}" for name, error in unfitted]
    told += [
        f"{one.case.name}, {model.name}: not identified: {one.failed}"
        for model in found
        for one in model.loads
        if one.failed
    ]
    told += _once(found)
    told += [_hidden(one, check) for one, check in checked if _on_axis(check)]
    agree = all(check.agrees for _, check in checked)
    if len(checked) == 1:
        told.append(
            "a single load: nothing else tells drive gains, so that a mass that is wrong by what "
            "they may be off cannot be told from them; record a second and a third"
        )
    if len(checked) == 2 and not agree:
        told.append("two loads contradict each other: which is wrong is a guess; record a third")
    told += _shared(checked) if agree else ()
    return (*told, *_above(found[0]))


def _once(found: Sequence[UnderLoads]) -> Iterator[str]:
    most = max(len(model.folds) for model in found)
    few = [model.name for model in found if len(model.folds) < most]
    if few:
        yield (
            f"{listed(few)}: judged on the first motions held out alone, the others on all: their "
            "figures are of different motions"
        )


def _on_axis(check: Declaration) -> bool:
    return not (check.mount_observable or check.declared.is_empty)


def _hidden(one: Scored, check: Declaration) -> str:
    reach = 1e3 * float(np.max(check.limit[1:3]))
    return (
        f"{one.case.name}: the centre of mass cannot be told from the flange's axis "
        f"(±{reach:.0f} mm), so that the angle at which it is mounted cannot be observed"
    )


def _shared(checked: Sequence[tuple[Scored, Declaration]]) -> Iterator[str]:
    """All loads off by the same mass: each alone within its limit, together hardly by chance."""
    if len(checked) < 2:
        return
    off = np.array([check.found[0] - check.declared.mass for _, check in checked])
    share = np.abs(off) / [check.limit[0] for _, check in checked]
    sizes = np.abs(off)
    if (
        np.ptp(np.sign(off)) == 0
        and np.max(sizes) <= ALIKE * np.min(sizes)
        and np.all(share > BEYOND / len(checked))
        and np.max(share) > BEYOND
    ):
        more = "heavier" if off[0] > 0 else "lighter"
        yield (
            f"every load is found {np.min(sizes):.2f} to {np.max(sizes):.2f} kg {more} than "
            "declared: an adapter that nobody declared, or a first load that is not what it says"
        )


def _above(model: UnderLoads) -> Iterator[str]:
    """Loads told of as declared that err much more than as identified."""
    for one in model.loads:
        declared, identified = average(one, "declared"), average(one, "identified")
        if declared and identified and declared > ABOVE * identified:
            yield (
                f"{one.case.name}, {model.name}: as declared it errs {declared / identified:.2f} "
                "times as much as identified: drive gains or the declaration may be off, by less "
                "than its limits"
            )


def _wrong(found: Sequence[Scored], false_alarm: float) -> Iterator[str]:
    checked = [(one, one.check) for one in found if one.check]
    wrong = [(one, check) for one, check in checked if not check.agrees]
    for one, check in wrong:
        yield f"{one.case.name}: {'; '.join(finding.text for finding in check.findings)}."
    rest = f"Of correct ones at most {100 * false_alarm:.2g} % would be called wrong."
    if len(checked) == 1 and not wrong:
        yield f"The declared load agrees with the one identified. {rest}"
    elif checked and not wrong:
        yield f"All {len(checked)} declared loads agree with those identified. {rest}"
    elif checked:
        are = "is" if len(wrong) == 1 else "are"
        yield f"{len(wrong)} of {len(checked)} declared loads {are} contradicted. {rest}"
    if checked:
        limits = [f"{check.limit[0]:.2f} kg ({one.case.name})" for one, check in checked]
        yield f"Masses wrong by less than this would not have been flagged: {listed(limits)}."


def _worst(model: UnderLoads) -> str:
    bare, (worst, ratio) = model.loads[0], model.worst()
    least, most = model.spread()
    several = f", {least:.2f} to {most:.2f} by which motions are held out"
    spread = several if len(model.folds) > 1 else ""
    words = {"declared": f"declared ({ratio:.2f} times that of {bare.case.name}{spread})"}
    each = [(words.get(told, told), average(worst, told)) for told in TOLD]
    figures = [f"{number:.3g} N·m {told}" for told, number in each if number is not None]
    return (
        f"{model.name}, mean over the joints: {mean_of(bare.errors['declared']):.3g} N·m with "
        f"{bare.case.name}; at worst, with {worst.case.name}, {listed(figures)}."
    )
