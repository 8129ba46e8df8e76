"""The page of `hil schedule simulate`: weeks of a mock, what changed, and what was done.

`found` judges the weeks by themselves, without a page: changes seen or not, promotions, errors
before and after.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FloatArray, read_json, require_known_version
from hil.models import REFERENCE, ChartedProbe, Entry, Registry, charted_probes
from hil.report import colours
from hil.report.drift_page import Along, champion_changes, drift_sections, effort_unit, joints_over
from hil.report.page import (
    Badge,
    Block,
    Cell,
    Column,
    KeyFigure,
    Notes,
    Page,
    Section,
    Table,
    cells,
    write_page,
)
from hil.report.words import UNKNOWN, duration, joint_title, listed, number
from hil.studies import Axis, Curve, Figure, Look

Document = Mapping[str, Any]

SHORTLY = 0.12
"""Weeks after its probe at which a new champion is drawn."""


def render_simulation(folder: Path) -> Path:
    """Write the page of a simulation into its folder.

    Raises:
        DataError, RecordingError: The document cannot be read, or the page not be written.
        RegistryError: The registry of the simulation was changed.
    """
    return write_page(simulation_page(folder), folder / "report.html")


def simulation_page(folder: Path) -> Page:
    """The page as blocks.

    Raises:
        DataError, RegistryError: See `render_simulation`.
    """
    told = read_json(folder / "simulation.json")
    require_known_version(folder / "simulation.json", told, "hil_simulation", 1)
    registry, model = Registry(folder / "registry"), str(told["model"])
    probes, along = _in_weeks(charted_probes(registry, model), told)
    unit = effort_unit(registry, model)
    what = found(told)
    return Page(
        title=str(told["name"]),
        subtitle=f"{told['weeks']:g} weeks of a mock, lived through at once",
        badge=_badge(what),
        summary=" ".join(what.sentences),
        key_figures=tuple(_key_figures(told, what)),
        sections=(
            Section("shown", "What it shows", "", tuple(_shown(told, what))),
            _timeline(told, what, along, unit),
            _warmth(told, unit),
            *(drift_sections(probes, along, unit) if probes else ()),
            _champions(registry.log(model), told),
        ),
        footer=f"Made by hil {version('hil')} from the simulation's folder. The robot is the "
        "embedded mock: the loop, the work and the registry are those of a real one, the clock and "
        "the weather are not.",
    )


def _in_weeks(told: Sequence[ChartedProbe], document: Document) -> tuple[list[ChartedProbe], Along]:
    """Probes with the week they were due in."""
    weeks = {
        each["result"]["drift"]["uid"]: float(each["week"])
        for each in document["occasions"]
        if each["result"] and each["result"]["drift"]
    }
    kept = [one for one in told if one.probe.uid in weeks]
    changes = [
        (float(each["week"]) + SHORTLY, str(each["result"]["champion"]))
        for each in document["occasions"]
        if each["result"] and each["result"]["champion"] != each["result"]["before"]
    ]
    x = tuple(weeks[one.probe.uid] for one in kept)
    return kept, Along(x, "week [1]", "week", tuple(changes))


def _badge(what: Found) -> Badge:
    missed = [one for one in what.criteria if not one.met]
    if not missed:
        return Badge(f"all {len(what.criteria)} as it should be", "pass")
    return Badge(f"{len(missed)} of {len(what.criteria)} not as it should be", "fail")


def _key_figures(told: Document, what: Found) -> list[KeyFigure]:
    promoted = [f"week {week:g}" for week in what.promoted]
    figures_ = [
        KeyFigure(
            "probe", duration(told["probe_s"]),
            f"of motion, {duration(told['warm_up_s'])} of it to warm up",
        ),
        KeyFigure(
            "false alarms", f"≤ {100 * told['false_alarm']:g} %",
            "of probes of an unchanged robot, all joints and causes together",
        ),
        KeyFigure("promoted", listed(promoted) or UNKNOWN, "the first champion counts"),
    ]  # fmt: skip
    if np.isfinite(what.after).any():
        label = f"of the error of week {what.first_week:g}, mean over joints and weeks"
        figures_.append(
            KeyFigure("error after the last promotion", f"{100 * np.mean(what.after):.0f} %", label)
        )
    return figures_


def _shown(told: Document, what: Found) -> list[Block]:
    columns = tuple(Column(title, number=False) for title in ("what", "met", "found"))
    rows = tuple(
        (Cell(one.asked), Cell("yes", "pass") if one.met else Cell("no", "fail"), Cell(one.found))
        for one in what.criteria
    )
    low, high = told["simulate"]["room_c"]
    notes = [
        f"A probe moves the robot for {duration(told['probe_s'])}, "
        f"{duration(told['warm_up_s'])} of that to warm up; the full program for "
        f"{duration(told['campaign_s'])}.",
        f"A probe of an unchanged robot is called changed with a probability of at most "
        f"{100 * told['false_alarm']:g} %, over all joints and causes together.",
        f"Every occasion finds the room between {low:g} and {high:g} °C, and measures with noise "
        "of its own.",
        f"With every new champion the comparison begins anew: its first {REFERENCE} probes tell "
        "what the robot is like under it, and limits are wide until then.",
        *_warmth_beside_wear(told),
    ]
    return [Table("What the weeks show", columns, rows), Notes(tuple(notes))]


def _warmth_beside_wear(told: Document) -> Iterator[str]:
    """How much friction changes without any wear, of the joints that wear."""
    if told["warmth"] is None:
        return
    part = told["warmth"]["all"]
    worn_ones = {
        j for one in told["simulate"]["wear"] for j, x in enumerate(one["factors"]) if x != 1
    }
    for j in sorted(worn_ones):
        cold, warm = part["from_c"][j], part["to_c"][j]
        yield (
            f"Warmth alone changes the friction of J{j + 1} by "
            f"{100 * part['friction_change'][j]:+.0f} % between the coldest moment of all runs "
            f"({cold:.0f} °C) and the warmest ({warm:.0f} °C)."
        )


def _timeline(told: Document, what: Found, along: Along, unit: str) -> Section:
    plots = (_errors(what, along, unit),) if what.weeks else ()
    return Section("weeks", "Week by week", "", (*plots, _weeks_table(told, what)))


MEAN = Look(colours.MEASURED, size=6)


def _errors(what: Found, along: Along, unit: str) -> Figure:
    joints, errors = what.joints, what.errors
    at = Along(what.weeks, "week [1]", "week", along.changes)
    title = "The champion's error on each week's probe"
    each = joints_over(title, errors, at, joints, f"RMSE [{unit}]", log=True)
    overall = 100 * np.mean(errors / what.level, axis=1)
    share = f"share of week {what.first_week:g} [%]"
    mean = Curve("", what.weeks, overall, "marked", look=MEAN)
    together = at.panel(
        "The same, mean over the joints",
        share,
        [mean],
        y_axis=Axis(from_zero=True),
        alt=f"mean error, {share}: {number(float(overall.min()))} to "
        f"{number(float(overall.max()))}",
        wide=True,
    )
    lead = (
        "Before what a week brings, and after it where a challenger was promoted. The dotted lines "
        "are new champions."
    )
    return Figure("error", "Error", lead, (each, together), 0)


def _weeks_table(told: Document, what: Found) -> Table:
    columns = (
        Column("week", number=False), Column("what came of it", number=False),
        Column("champion", number=False), Column("error [%]", number=False),
        Column("room [°C]", number=False),
        Column("friction", number=False),
    )  # fmt: skip
    rows = tuple(
        (
            Cell(f"{each['week']:g}"),
            Cell(*_came_of(each)),
            Cell(str((each["result"] or {}).get("champion") or UNKNOWN)),
            Cell(what.share_of(each)),
            Cell(f"{each['room_c']:g}"),
            Cell(worn(each["wear"], "{joint}\u00a0×\u00a0{factor:g}")),
        )
        for each in told["occasions"]
    )
    note = (
        "Error: of the champion on the probe, before anything is done about it; mean over the "
        f"joints, as a share of week {what.first_week:g}."
    )
    return Table("Every occasion", columns, rows, note if what.weeks else "")


def _came_of(each: Document) -> tuple[str, Any]:
    if each["result"] is None:
        return f"{each['event']}: {each['why']}", "fail" if each["event"] == "failed" else "warn"
    marks = {"promoted": "pass", "kept": "warn", "drift": "warn"}
    drift, text = each["result"]["drift"], str(each["result"]["text"])
    # A decision says why the campaign was run, which is what the probe has told.
    said = f"{drift['text']}. " if drift and drift["text"] not in text else ""
    return f"{said}{text}", marks.get(each["result"]["outcome"], "")


def _warmth(told: Document, unit: str) -> Section:
    """The room, and what warmth alone does to friction."""
    occasions = told["occasions"]
    weeks = np.array([float(each["week"]) for each in occasions])
    room = np.array([float(each["room_c"]) for each in occasions])
    curve = Curve("", weeks, room, "marked", look=Look(colours.NEUTRAL, size=6))
    panel = Along(tuple(weeks), "week [1]", "week").panel(
        "The room",
        "temperature [°C]",
        [curve],
        alt=f"room from {room.min():g} to {room.max():g} °C",
        wide=True,
    )
    lead = "Drawn anew for every occasion."
    drawn = Figure("room", "Temperature of the room", lead, (panel,), 0)
    return Section("warmth", "Warmth", "", (*_warmth_table(told), drawn))


def _warmth_table(told: Document) -> list[Block]:
    warmth = told.get("warmth")
    if warmth is None:
        return []
    columns = [Column("joint", number=False)]
    for group in ("first campaign, begin to end", "coldest to warmest moment of all"):
        columns += [Column("temperature [°C]", group, False), Column("friction [%]", group)]
    rows = []
    for j, name in enumerate(warmth["joint_names"]):
        row = [joint_title(j, name)]
        for part in (warmth["campaign"], warmth["all"]):
            row += [f"{part['from_c'][j]:.1f} → {part['to_c'][j]:.1f}"]
            row += [f"{100 * part['friction_change'][j]:+.1f}"]
        rows.append(cells(*row))
    note = (
        "Over the probe's motion, by the law of the first champion; no probe may call it a change, "
        "and no challenger may win or lose by it."
    )
    return [Table("What warmth alone does to friction", tuple(columns), tuple(rows), note)]


def _champions(log: Sequence[Entry], told: Document) -> Section:
    """The registry's log, in weeks."""
    week = {
        each["result"]["challenger"]: f"week {each['week']:g}"
        for each in told["occasions"]
        if each["result"] and each["result"]["challenger"]
    }
    return champion_changes(
        [replace(entry, at=week.get(f"v{entry.version}", entry.at)) for entry in log]
    )


BACK = 1.1
"""Error, as a share of the first probe's, that counts as the same again: of all joints in the mean,
and of each joint that has worn, beyond what wear does to what no model knows of its friction."""


@dataclass(frozen=True, slots=True)
class Criterion:
    """Something that should be so.

    Attributes:
        asked: In words.
        met: Whether it is.
        found: What is.
    """

    asked: str
    met: bool
    found: str


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What the weeks show.

    Attributes:
        joints: Names.
        weeks: Of `errors`; a week in which a challenger was promoted is there twice.
        errors: (P, n) RMSE of the champion of that moment on the week's probe.
        level: (n,) of the first probe.
        first_week: When that was.
        promoted: Weeks.
        after: (n,) errors as shares of `level`, mean over the probes after the last change's
            promotion; NaN where there are none.
        criteria: What should be so.
        sentences: The whole in words.
    """

    joints: tuple[str, ...]
    weeks: tuple[float, ...]
    errors: FloatArray
    level: FloatArray
    first_week: float
    promoted: tuple[float, ...]
    after: FloatArray
    criteria: tuple[Criterion, ...]
    sentences: tuple[str, ...]

    def share_of(self, occasion: Document) -> str:
        """Mean error of an occasion's probe as a share of the first one's, in percent."""
        errors = _errors_of(occasion)
        if errors is None:
            return UNKNOWN
        return f"{100 * float(np.mean(np.array(errors['before']) / self.level)):.0f}"


def _errors_of(occasion: Document) -> Any:
    return occasion["result"] and occasion["result"]["errors"]


def found(told: Document) -> Found:
    """Look through a simulation's document."""
    occasions = told["occasions"]
    rows = [row for each in occasions for row in _rows(each)]
    known = next((errors for each in occasions if (errors := _errors_of(each))), None)
    joints = tuple(known["joint_names"]) if known else ()
    errors = np.array([row for _, row in rows]).reshape(len(rows), len(joints))
    level = errors[0] if len(errors) else np.empty(0)
    promoted = tuple(float(each["week"]) for each in occasions if _is(each, "promoted"))
    weeks = tuple(week for week, _ in rows)
    after = _after(told, weeks, errors, promoted)
    criteria = (*_criteria(told, occasions), *_back(told, after))
    return Found(
        joints, weeks, errors, level, weeks[0] if weeks else float("nan"), promoted, after,
        criteria, tuple(_sentences(told, after)),
    )  # fmt: skip


def _rows(occasion: Document) -> list[tuple[float, list[float]]]:
    errors = _errors_of(occasion)
    if errors is None:
        return []
    keys = ("before", "after") if _is(occasion, "promoted") else ("before",)
    return [(float(occasion["week"]), errors[key]) for key in keys]


def _is(occasion: Document, outcome: str) -> bool:
    return bool(occasion["result"]) and occasion["result"]["outcome"] == outcome


def _after(
    told: Document, weeks: Sequence[float], errors: FloatArray, promoted: Sequence[float]
) -> FloatArray:
    """(n,) mean errors after the promotion that followed the last change, as shares of before."""
    began = max(told["wear_weeks"], default=np.inf)
    last = next((week for week in promoted if weeks and week >= began and week > weeks[0]), None)
    if last is None:
        return np.full(errors.shape[1], np.nan)
    first = [i for i, week in enumerate(weeks) if week == last][-1]
    return np.asarray(np.mean(errors[first:] / errors[0], axis=0))


def _criteria(told: Document, occasions: Sequence[Document]) -> list[Criterion]:
    rows: list[Criterion] = []
    expected: list[float] = []
    for weeks in told["wear_weeks"]:
        probe = next((each for each in occasions if each["week"] >= weeks), None)
        if probe is None:
            continue
        week = float(probe["week"])
        expected.append(week)
        drift = probe["result"] and probe["result"]["drift"]
        rows.append(Criterion(
            f"the change after {7 * weeks:g} days is seen by the first probe after it",
            _changed(probe), f"week {week:g}: {drift['text'] if drift else probe['why']}",
        ))  # fmt: skip
        rows.append(Criterion(
            "the robot is identified again, and the challenger promoted",
            _is(probe, "promoted"), str((probe["result"] or {}).get("text", probe["why"])),
        ))  # fmt: skip
    needless = [
        float(each["week"])
        for each in occasions
        if _is(each, "promoted") and each["result"]["before"] and each["week"] not in expected
    ]
    rows.append(Criterion(
        "nothing is promoted without a change", not needless,
        listed([f"week {week:g}" for week in needless]) or "in no week",
    ))  # fmt: skip
    alarms = [each for each in occasions if _changed(each) and float(each["week"]) not in expected]
    probes = sum(bool(each["result"] and each["result"]["drift"]) for each in occasions)
    rows.append(Criterion(
        "no probe without a change calls the robot changed", not alarms,
        f"{len(alarms)} of {probes - len(expected)} do",
    ))  # fmt: skip
    return rows


def _changed(occasion: Document) -> bool:
    drift = occasion["result"] and occasion["result"]["drift"]
    return bool(drift and drift["changed"])


def _back(told: Document, after: FloatArray) -> Iterator[Criterion]:
    """Whether the error is that of the first probe again, of all joints and of those that wore."""
    if not any(each["week"] >= weeks for weeks in told["wear_weeks"] for each in told["occasions"]):
        return
    mean = float(np.mean(after)) if len(after) else float("nan")
    yield Criterion(
        f"the error is back at that of the first probe, within {100 * (BACK - 1):.0f} %",
        mean <= BACK,
        f"{number(100 * mean)} % of it, mean over the joints and the probes since",
    )
    for j, factor in _worn(told):
        limit = BACK * max(factor, 1.0)
        share = float(after[j]) if len(after) else float("nan")
        yield Criterion(
            f"so is that of J{j + 1} by itself, within {100 * (BACK - 1):.0f} % beyond the wear: "
            f"at most {100 * limit:g} % of its own",
            share <= limit, f"{number(100 * share)} % of it, mean over the probes since",
        )  # fmt: skip


def _worn(told: Document) -> list[tuple[int, float]]:
    """Joints that are not as new in the end, and how much more friction they have."""
    factors = told["simulate"]["wear"][-1]["factors"] if told["wear_weeks"] else ()
    return [(j, float(factor)) for j, factor in enumerate(factors) if factor != 1]


def _sentences(told: Document, after: FloatArray) -> list[str]:
    occasions = told["occasions"]
    probes = sum(bool(each["result"] and each["result"]["drift"]) for each in occasions)
    end = told.get("weeks", np.inf)
    last = max((each["week"] for each in occasions), default=0)
    changes = [
        f"after {7 * weeks:g} days friction is {worn(one['factors'])}"
        if weeks < end or weeks <= last
        else f"wear of day {7 * weeks:g} is beyond these {end:g} weeks: not shown"
        for weeks, one in zip(told["wear_weeks"], told["simulate"]["wear"], strict=True)
    ]
    said = [f"{probes} probes; {'; '.join(changes) or 'no wear'}."]
    for each in occasions:
        if _changed(each):
            result = each["result"]
            came = {"promoted": f"{result['champion']} is promoted", "kept": "the champion stays"}
            told_then = came.get(result["outcome"], "nothing is done")
            said.append(f"Week {each['week']:g}: {result['drift']['text']}; {told_then}.")
    if np.isfinite(after).any():
        each = [f"that of J{j + 1} {100 * after[j]:.0f} %" for j, _ in _worn(told)]
        mean = f"the mean error is {100 * float(np.mean(after)):.0f} % of the first probe's"
        said.append(f"Since then {listed([mean, *each])}.")
    return said


def worn(factors: Sequence[float], form: str = "{factor:g} times as much on {joint}") -> str:
    """Wear in words: `1.15 times as much on J2`; `as new` where there is none."""
    named = ((f"J{j + 1}", factor) for j, factor in enumerate(factors) if factor != 1)
    return ", ".join(form.format(joint=joint, factor=factor) for joint, factor in named) or "as new"
