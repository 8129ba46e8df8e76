"""Tables, figures and sentences of a study of loads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import HilError
from hil.estimators import NAMES, Declaration, true_values
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.load_models import TOLD, Scored, UnderLoads
from hil.studies.result import Table, Value, joint_titles, listed, mean_of, value, values, with_mean

FIRST_INERTIA = 4
"""Where inertias begin in `NAMES`."""

_WAYS = {
    "unaware": "the model is not told that anything is mounted",
    "declared": "it is told the load of the spec",
    "calibrated": "the same, with the drive gains that the other loads tell",
    "identified": "it is told the load that other motions with it show",
}

WAYS = ". ".join(f"{told.capitalize()}: {_WAYS[told]}" for told in TOLD if told in _WAYS) + "."
"""One line on what a model may be told."""

TORQUES = (
    "In N·m, so that joints compare: where currents were measured, they are multiplied by the "
    "drive gains."
)

_ERRORS_NOTE = f"Against the filtered torque. {WAYS} {TORQUES}"


def errors(found: Sequence[UnderLoads]) -> Table:
    """RMSE per joint, by load, model and what it is told."""
    n = len(found[0].loads[0].errors["unaware"])
    rows: list[tuple[Value, ...]] = [
        (f"{one.case.name}, {model.name}, {told}", *with_mean(one.errors[told]))
        for model, one in _by_load(found)
        for told in TOLD
        if told in one.errors
    ]
    title = "RMSE on motions held out, by load and what is told of it [N·m]"
    columns = ("load", *joint_titles(n), "mean")
    return Table("table-load-errors", title, columns, tuple(rows), _ERRORS_NOTE)


def _by_load(found: Sequence[UnderLoads]) -> Iterator[tuple[UnderLoads, Scored]]:
    """Every model under the first load, then every model under the second."""
    for each in zip(*(model.loads for model in found), strict=True):
        yield from zip(found, each, strict=True)


_CHECK_NOTE = (
    "A turned tool would show: its centre of mass is far enough beside the flange's axis; where it "
    "is not, the angle at which it is mounted cannot be checked. Used to correct gains: this load "
    "agrees with the others, so that together they tell how far the drive gains are off."
)


def declarations(model: UnderLoads) -> Table:
    """The verdict on every declared load, by one model."""
    rows = [(one.case.name, *_verdict(one)) for one in model.loads if one.case.told is not None]
    columns = (
        "load", "declaration", "what is wrong", "a turned tool would show", "used to correct gains"
    )  # fmt: skip
    title = f"Declared loads, checked by {model.name}"
    return Table("table-declarations", title, columns, tuple(rows), _CHECK_NOTE)


def _verdict(one: Scored) -> tuple[Value, ...]:
    check = one.check
    if check is None:
        return "not checked", one.failed, None, None
    wrong = "; ".join(finding.text for finding in check.findings)
    turned = _yes(check.mount_observable)
    return "agrees" if check.agrees else "CONTRADICTED", wrong or "–", turned, _yes(check.trusted)


def _yes(true: bool) -> str:
    return "yes" if true else "no"


_IDENTIFIED_NOTE = (
    "Declared: in the spec. Identified: from the motions with the load, with drive gains as the "
    "other loads tell them. Difference: identified less declared. Allowed: a larger difference "
    "contradicts the declaration."
)

_WEIGHED_NOTE = (
    "The weighing before the motions measures the same mass from a few poses at rest, and its ± is "
    "one standard deviation. What is allowed here is almost four; both include what the drive "
    "gains may have wrong, which no repetition shows."
)


def identified(model: UnderLoads) -> tuple[Table, ...]:
    """Mass and centre of every load, declared and identified; inertia where it is determined."""
    kinds = (
        ("table-mass", "Mass [kg]", slice(0, 1), 1.0, 3, f"{_IDENTIFIED_NOTE} {_WEIGHED_NOTE}"),
        ("table-centre", "Centre of mass in the flange's frame [mm]", slice(1, 4), 1e3, 1, ""),
        ("table-inertia", "Inertia about the centre [10⁻³ kg·m²]", slice(4, 10), 1e3, 2, ""),
    )
    columns = ("load", "declared", "identified", "difference", "allowed ±")
    return tuple(
        Table(key, f"{title}, by {model.name}", columns, rows, note, decimals)
        for key, title, which, scale, decimals, note in kinds
        if (rows := tuple(row for one in model.loads for row in _quantities(one, which, scale)))
    )


_AXES = ("", "x", "y", "z", *(name[1:] for name in NAMES[4:]))


def _quantities(one: Scored, which: slice, scale: float) -> Iterator[tuple[Value, ...]]:
    if one.check is None or one.estimate is None:
        return
    empty = one.case.declared.is_empty
    told = np.zeros(len(NAMES)) if empty else true_values(one.case.declared)
    known = one.estimate.determined
    for i in range(len(NAMES))[which]:
        # An inertia that nobody can tell is a row of noise.
        if i >= FIRST_INERTIA and not known[NAMES[i]]:
            continue
        declared, found, limit = (
            float(scale * of[i]) for of in (told, one.check.found, one.check.limit)
        )
        name = f"{one.case.name}, {_AXES[i]}" if _AXES[i] else one.case.name
        yield (name, *values([declared, found, found - declared, limit]))


def figures(found: Sequence[UnderLoads]) -> tuple[Figure, ...]:
    """Fig. 8(b) of the PINN paper for every model, and the models side by side at every joint."""
    return _by_what_is_told(found), _by_joint(found)


def _by_what_is_told(found: Sequence[UnderLoads]) -> Figure:
    """For every model a panel with everything, and one without what sets the scale of that."""
    aware = [told for told in TOLD if told != "unaware"]
    panels = tuple(
        _panel(title, [(told, model, told) for told in ways])
        for model in found
        for title, ways in ((model.name, TOLD), (f"{model.name}, told of the load", aware))
    )
    caption = (
        f"Mean over the joints of the RMSE on motions held out; nothing was learned with a load. "
        f"{WAYS} On the right the same without the unaware model, on its own scale. {TORQUES} "
        "Drawn as Fig. 8(b) of the paper on physics-informed networks (PINN)."
    )
    return Figure("fig-load-errors", "Errors under loads", caption, panels, 2)


_Bars = tuple[str, UnderLoads, str]
"""Name in the legend, the model, and what it is told."""


def _panel(title: str, curves: Sequence[_Bars], joint: int | None = None) -> Panel:
    bars = tuple(
        Curve(
            name,
            tuple(one.case.name for one in model.loads),
            tuple(_height(one, told, joint) for one in model.loads),
            "bars",
        )
        for name, model, told in curves
        if any(told in one.errors for one in model.loads)
    )
    return Panel(title, "load", "RMSE [N·m]", bars)


def _height(one: Scored, told: str, joint: int | None) -> float:
    error = one.errors.get(told)
    if error is None:
        return float("nan")
    return float(mean_of(error) if joint is None else error[joint])


def _by_joint(found: Sequence[UnderLoads]) -> Figure:
    several = len(found) > 1
    curves: list[_Bars] = (
        [(model.name, model, "declared") for model in found]
        if several
        else [(told, found[0], told) for told in TOLD]
    )
    n = len(found[0].loads[0].errors["unaware"])
    panels = tuple(_panel(title, curves, j) for j, title in enumerate(joint_titles(n)))
    told = "told of the load as the spec declares it" if several else "told and not told"
    caption = f"RMSE on motions held out, {told}. Every joint has its own scale."
    return Figure("fig-load-joints", "Errors under loads by joint", caption, panels, 2)


def average(one: Scored, told: str) -> float | None:
    """Mean over the joints; None where there is none."""
    return value(_height(one, told, None))


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


def _hidden(one: Scored, check: Declaration) -> str:
    reach = 1e3 * float(np.max(check.limit[1:3]))
    return (
        f"{one.case.name}: the centre of mass cannot be told from the flange's axis "
        f"(±{reach:.0f} mm), so that the angle at which it is mounted cannot be observed"
    )


def _on_axis(check: Declaration) -> bool:
    return not (check.mount_observable or check.declared.is_empty)


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
