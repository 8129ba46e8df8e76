"""Tables and figures of a study of loads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hil.identify.payload_estimate import NAMES, UNITS
from hil.identify.payload_fit import true_values
from hil.study.load_score import TOLD, Scored, UnderLoads
from hil.study.result import Curve, Figure, Panel, Table, Value
from hil.study.separation_text import joint_titles, mean_of, value, values, with_mean


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


_ERRORS_NOTE = (
    "Against the filtered torque. Unaware: the load is forgotten. Declared: as the spec has it. "
    "Identified: from other motions with this load; friction stays the model's own."
)


def declarations(model: UnderLoads) -> Table:
    """The verdict on every declared load, by one model."""
    rows = [(one.case.name, *_verdict(one)) for one in model.loads if one.case.told is not None]
    columns = ("load", "declaration", "what contradicts it", "angle of the mount", "gains by it")
    title = f"Declared loads, checked by {model.name}"
    return Table("table-declarations", title, columns, tuple(rows), _CHECK_NOTE)


_CHECK_NOTE = (
    "Gains by it: whether it is among the loads that agree with one another, which tell the others "
    "how far the drive gains are off. An angle that cannot be seen: the declared centre of mass is "
    "on the flange's axis, as closely as can be told."
)


def _verdict(one: Scored) -> tuple[Value, ...]:
    check = one.check
    if check is None:
        return "not checked", one.failed, None, None
    wrong = "; ".join(finding.text for finding in check.findings)
    seen = "seen" if check.mount_observable else "cannot be seen"
    return "agrees" if check.agrees else "CONTRADICTED", wrong, seen, _yes(check.trusted)


def _yes(true: bool) -> str:
    return "yes" if true else "no"


def identified(model: UnderLoads) -> Table:
    """Every quantity of every load: declared, identified, and how far off it may be."""
    rows = tuple(row for one in model.loads for row in _quantities(one))
    columns = ("quantity", "declared", "identified", "± std", "gains told", "off", "may be off")
    title = f"Loads, declared and identified by {model.name}"
    return Table("table-identified", title, columns, rows, _IDENTIFIED_NOTE)


_IDENTIFIED_NOTE = (
    "± std knows of noise alone. Gains told: with the drive gains that the other loads leave "
    "probable, which is what counts. What may be off includes what gains and model have wrong."
)


def _quantities(one: Scored) -> Iterator[tuple[Value, ...]]:
    if one.check is None or one.estimate is None:
        return
    empty = one.case.declared.is_empty
    told = [0.0] * len(NAMES) if empty else true_values(one.case.declared).tolist()
    rows = zip(
        NAMES, UNITS, told, one.estimate.values, one.estimate.std_error, one.check.found,
        one.check.limit, strict=True,
    )  # fmt: skip
    for name, unit, declared, raw, error, corrected, limit in rows:
        numbers = (declared, raw, error, corrected, corrected - declared, limit)
        yield (f"{one.case.name}: {name} [{unit}]", *values([float(x) for x in numbers]))


def figures(found: Sequence[UnderLoads]) -> tuple[Figure, ...]:
    """Fig. 8(b) of the PINN paper for every model, and the models side by side at every joint."""
    return _by_what_is_told(found), _by_joint(found)


def _by_what_is_told(found: Sequence[UnderLoads]) -> Figure:
    panels = tuple(_panel(model.name, [(told, model, told) for told in TOLD]) for model in found)
    caption = (
        "Mean over the joints of the RMSE on motions held out (Fig. 8b of the PINN paper); nothing "
        "was learned with a load. Unaware: nobody tells of it; declared: by the spec; identified: "
        "from other motions."
    )
    return Figure("fig-load-errors", "Errors under loads", caption, panels, 2)


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
    caption = f"RMSE on motions held out, {told}."
    return Figure("fig-load-joints", "Errors under loads by joint", caption, panels, 2)


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
    )
    return Panel(title, "load", "RMSE [N·m]", bars)


def _height(one: Scored, told: str, joint: int | None) -> float:
    error = one.errors.get(told)
    if error is None:
        return float("nan")
    return float(mean_of(error) if joint is None else error[joint])


def average(one: Scored, told: str) -> float | None:
    """Mean over the joints; None where there is none."""
    return value(_height(one, told, None))
