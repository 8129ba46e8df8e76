"""Tables, figures and summary sentences of the load-validation study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import HilError
from hil.estimators import NAMES, Declaration, true_values
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.load_models import TOLD, Scored, UnderLoads
from hil.studies.result import Table, Value, joint_titles, listed, mean_of, value, values, with_mean

FIRST_INERTIA = 4
"""Index of the first moment of inertia in the parameter names `NAMES`."""

_WAYS = {
    "unaware": "the model has no information about the load",
    "declared": "the model uses the load of the spec",
    "calibrated": "the same, with drive gains corrected by means of the other loads",
    "identified": "the model uses the load identified from other motions",
}

WAYS = ". ".join(f"{told.capitalize()}: {_WAYS[told]}" for told in TOLD if told in _WAYS) + "."
"""Texts that explain the kinds of payload information a model can receive."""

TORQUES = (
    "All errors are in N·m, to compare joints; measured currents are multiplied by the drive gains."
)

_ERRORS_NOTE = f"Errors relative to the filtered torque. {WAYS} {TORQUES}"


def errors(found: Sequence[UnderLoads]) -> Table:
    """Return the table of the RMSE per joint, by payload, model and payload information."""
    n = len(found[0].loads[0].errors["unaware"])
    rows: list[tuple[Value, ...]] = [
        (f"{one.case.name}, {model.name}, {told}", *with_mean(one.errors[told]))
        for model, one in _by_load(found)
        for told in TOLD
        if told in one.errors
    ]
    title = "RMSE on held-out motions, by load and information about the load [N·m]"
    columns = ("load", *joint_titles(n), "mean")
    return Table("table-load-errors", title, columns, tuple(rows), _ERRORS_NOTE)


def _by_load(found: Sequence[UnderLoads]) -> Iterator[tuple[UnderLoads, Scored]]:
    """Yield the results of all models for the first payload, then for the second payload, etc."""
    for each in zip(*(model.loads for model in found), strict=True):
        yield from zip(found, each, strict=True)


_CHECK_NOTE = (
    "Mounting angle observable: the centre of mass is far enough from the axis of the flange; "
    "otherwise a rotated tool cannot be detected. Used to correct gains: this load agrees with the "
    "others, so that it contributes to the correction of the drive gains."
)


def declarations(model: UnderLoads) -> Table:
    """Return the table of the checks of all declared payloads by one model."""
    rows = [(one.case.name, *_verdict(one)) for one in model.loads if one.case.told is not None]
    columns = (
        "load", "declaration", "problem", "mounting angle observable", "used to correct gains"
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
    "Declared: from the spec. Identified: from the motions with the load, with drive gains "
    "corrected by means of the other loads. Difference: identified minus declared. Allowed: a "
    "larger difference contradicts the declaration."
)

_WEIGHED_NOTE = (
    "The weighing before the motions measures the same mass in a few static poses; its ± is one "
    "standard deviation. The difference allowed here is almost four standard deviations. Both "
    "include the uncertainty of the drive gains, which does not show in repeated measurements."
)


def identified(model: UnderLoads) -> tuple[Table, ...]:
    """Return tables of the declared and identified mass and centre of mass of every payload.

    A table of the moments of inertia is included if the data determine them.
    """
    kinds = (
        ("table-mass", "Mass [kg]", slice(0, 1), 1.0, 3, f"{_IDENTIFIED_NOTE} {_WEIGHED_NOTE}"),
        ("table-centre", "Centre of mass in the flange frame [mm]", slice(1, 4), 1e3, 1, ""),
        (
            "table-inertia",
            "Inertia about the centre of mass [10⁻³ kg·m²]",
            slice(4, 10),
            1e3,
            2,
            "",
        ),
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
        # An inertia that the data do not determine would only be noise.
        if i >= FIRST_INERTIA and not known[NAMES[i]]:
            continue
        declared, found, limit = (
            float(scale * of[i]) for of in (told, one.check.found, one.check.limit)
        )
        name = f"{one.case.name}, {_AXES[i]}" if _AXES[i] else one.case.name
        yield (name, *values([declared, found, found - declared, limit]))


def figures(found: Sequence[UnderLoads]) -> tuple[Figure, ...]:
    """Return Fig. 8(b) of the PINN paper for every model, and a comparison of the models."""
    return _by_what_is_told(found), _by_joint(found)


def _by_what_is_told(found: Sequence[UnderLoads]) -> Figure:
    """Return a figure with two panels per model: all errors, and errors without `unaware`.

    The second panel omits the errors of `unaware`, because these large errors set the scale of the
    first panel.
    """
    aware = [told for told in TOLD if told != "unaware"]
    panels = tuple(
        _panel(title, [(told, model, told) for told in ways])
        for model in found
        for title, ways in ((model.name, TOLD), (f"{model.name}, aware of the load", aware))
    )
    caption = (
        f"Mean over the joints of the RMSE on held-out motions; no model was trained with a load. "
        f"{WAYS} Right: the same without the unaware model, on a separate scale. {TORQUES} "
        "Drawn like Fig. 8(b) of the paper on physics-informed networks (PINN)."
    )
    return Figure("fig-load-errors", "Errors under loads", caption, panels, 2)


_Bars = tuple[str, UnderLoads, str]
"""Tuple of legend name, model, and payload information that the model receives."""


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
    told = "with the load as declared in the spec" if several else "with and without load"
    caption = f"RMSE on held-out motions, {told}. Every joint has a separate scale."
    return Figure("fig-load-joints", "Errors under loads by joint", caption, panels, 2)


def average(one: Scored, told: str) -> float | None:
    """Return the mean error over the joints; None if no error is known."""
    return value(_height(one, told, None))


ALIKE = 1.5
"""Maximum ratio of the mass errors of different payloads that are treated as one common error."""

BEYOND = 0.5
"""Minimum mass error for a warning about a common error of all payloads, as a share of the error
limit.
"""

ABOVE = 1.25
"""Minimum ratio of the error with the declared payload to the error with the identified payload
that causes a warning.
"""

TEXT = (
    "All models were fitted with the first load only. Motions are held out under every load, and "
    "each load is identified from the other motions with this load. Every motion is evaluated "
    "once, by a model fitted to the other motions; errors are over all motions. Every model "
    "identifies the loads separately; the first model, fitted without the first held-out motions, "
    "checks the declarations.",
    "A declaration is contradicted if the identified load differs from it by more than noise, "
    "drive gains and model errors explain. A joint whose drive gain is larger than assumed makes "
    "every load appear too light; loads that agree with one another determine this error. With a "
    "single load, a wrong mass cannot be distinguished from wrong gains, and the limits are wider.",
)


def title(found: Sequence[UnderLoads], models: Sequence[str]) -> str:
    """Return the title, which states whether the models are stored or fitted for the study."""
    names = listed([one.name for one in found])
    if not models:
        return f"Validation under loads: {names}, fitted for this study"
    if all(model.startswith("fit/") for model in models):
        return f"Validation under loads: {names}, models of this run"
    return f"Validation under loads: {names}, stored in {listed(models)}"


def summary(found: Sequence[UnderLoads], false_alarm: float) -> tuple[str, ...]:
    """Return the main conclusions of the study, one sentence each."""
    return (*_wrong(found[0].loads, false_alarm), *(_worst(model) for model in found))


def _wrong(found: Sequence[Scored], false_alarm: float) -> Iterator[str]:
    checked = [(one, one.check) for one in found if one.check]
    wrong = [(one, check) for one, check in checked if not check.agrees]
    for one, check in wrong:
        yield f"{one.case.name}: {'; '.join(finding.text for finding in check.findings)}."
    rest = f"The probability of contradicting a correct load is at most {100 * false_alarm:.2g} %."
    if len(checked) == 1 and not wrong:
        yield f"The declared load agrees with the identified load. {rest}"
    elif checked and not wrong:
        yield f"All {len(checked)} declared loads agree with the identified loads. {rest}"
    elif checked:
        are = "is" if len(wrong) == 1 else "are"
        yield f"{len(wrong)} of {len(checked)} declared loads {are} contradicted. {rest}"
    if checked:
        limits = [f"{check.limit[0]:.2f} kg ({one.case.name})" for one, check in checked]
        yield f"Smaller errors of the declared mass cannot be detected: {listed(limits)}."


def _worst(model: UnderLoads) -> str:
    bare, (worst, ratio) = model.loads[0], model.worst()
    least, most = model.spread()
    several = f", {least:.2f} to {most:.2f} depending on the held-out motions"
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
    """Return warnings about failed fits, failed identifications and unreliable checks."""
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
            "a single load: the drive gains cannot be checked with other loads, so that an error "
            "of the mass cannot be distinguished from an error of the drive gains; record a second "
            "and a third load"
        )
    if len(checked) == 2 and not agree:
        told.append(
            "two loads contradict each other: which load is wrong cannot be determined; record a "
            "third load"
        )
    told += _shared(checked) if agree else ()
    return (*told, *_above(found[0]))


def _once(found: Sequence[UnderLoads]) -> Iterator[str]:
    most = max(len(model.folds) for model in found)
    few = [model.name for model in found if len(model.folds) < most]
    if few:
        yield (
            f"{listed(few)}: evaluated on the first held-out motions only, the other models on all "
            "motions: the errors are not directly comparable"
        )


def _hidden(one: Scored, check: Declaration) -> str:
    reach = 1e3 * float(np.max(check.limit[1:3]))
    return (
        f"{one.case.name}: the centre of mass cannot be distinguished from the axis of the flange "
        f"(±{reach:.0f} mm), so that the mounting angle cannot be checked"
    )


def _on_axis(check: Declaration) -> bool:
    return not (check.mount_observable or check.declared.is_empty)


def _shared(checked: Sequence[tuple[Scored, Declaration]]) -> Iterator[str]:
    """Yield a warning if the mass errors of all payloads are similar and have the same sign.

    Each mass error alone is within its limit, but equal errors of all payloads are unlikely to be a
    coincidence.
    """
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
            f"every identified load is {np.min(sizes):.2f} to {np.max(sizes):.2f} kg {more} than "
            "declared: an adapter is not declared, or the first load is declared wrongly"
        )


def _above(model: UnderLoads) -> Iterator[str]:
    """Yield warnings for payloads whose declaration causes much larger errors than the estimate."""
    for one in model.loads:
        declared, identified = average(one, "declared"), average(one, "identified")
        if declared and identified and declared > ABOVE * identified:
            yield (
                f"{one.case.name}, {model.name}: the error with the declared load is "
                f"{declared / identified:.2f} times that with the identified load: the drive gains "
                "or the declaration are possibly wrong, by less than the limits"
            )
