"""The page of a fleet: who has changed, who stands out, and friction over age and temperature."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.models import FAMILY_WISE, FEWEST, Comparison, Survey, SurveyedRobot
from hil.report import colours
from hil.report.page import Badge, Cell, Column, KeyFigure, Page, Section, Table, cells, write_page
from hil.report.words import UNKNOWN, joint_title, number
from hil.studies import Curve, Figure, Look, Panel

AXES = {"age": "time in service [years]", "temperature": "joint temperature [°C]"}
UNITS = {"age": "a year", "temperature": "a °C"}


def render_fleet(survey: Survey, path: Path) -> Path:
    """Write the page.

    Raises:
        RecordingError: It cannot be written.
    """
    return write_page(fleet_page(survey), path)


def fleet_page(survey: Survey) -> Page:
    """The page as blocks."""
    out = standing_out(survey)
    drifted = len(survey.drifted)
    probed = sum(one.probe is not None for one in survey.robots)
    return Page(
        title=survey.name,
        subtitle=f"Fleet of {len(survey.robots) + len(survey.missing)} robots",
        badge=Badge(f"{len(out)} of {len(survey.robots)} to look at", "warn" if out else "pass"),
        summary=_summary(survey),
        key_figures=(
            KeyFigure("measured", str(len(survey.robots)), _missing(survey)),
            KeyFigure("drifted", str(drifted) if probed else UNKNOWN, _of_probed(survey, probed)),
            KeyFigure("stand out", str(len(_outliers(survey))), "in friction, or its change"),
        ),
        warnings=(
            *(f"{one.robot}: {one.problem}" for one in survey.robots if one.problem),
            *_not_compared(survey),
        ),
        sections=(
            Section("look", "Robots to look at", "" if out else "None.", _table(survey, out)),
            *_sections(survey),
            Section("all", "All robots", "", (_all(survey),), folded=True),
        ),
        footer=f"Made by hil {version('hil')} from {survey.folder.name}, its runs and what probes "
        "said; it can be made again at any time: hil fleet report.",
    )


def standing_out(survey: Survey) -> list[tuple[SurveyedRobot, str]]:
    """Robots to look at and why, in the fleet's order."""
    told: dict[str, list[str]] = {}
    for one in survey.drifted:
        assert one.probe is not None
        told.setdefault(one.robot, []).append(one.probe.text)
    for robot, text in _outliers(survey):
        told.setdefault(robot, []).append(text)
    return [(one, "; ".join(told[one.robot])) for one in survey.robots if one.robot in told]


def _outliers(survey: Survey) -> list[tuple[str, str]]:
    """Robot and words of everything that stands out."""
    found = []
    for which, what, values in (
        (survey.friction, "friction", [one.friction for one in survey.robots]),
        (survey.change, "change of friction", [one.change for one in survey.robots]),
    ):
        for i, j in survey.outlying(which):
            assert which is not None
            share = values[i][j] / which.expected[i, j] - 1.0
            one = survey.robots[i]
            text = (
                f"{what} of {one.joint_names[j]} {100 * share:+.0f} % off (z {which.z[i, j]:.1f})"
            )
            found.append((one.robot, text))
    return found


def _summary(survey: Survey) -> str:
    if survey.friction is None:
        return f"With fewer than {FEWEST} robots outliers cannot be tested."
    after = " and ".join(survey.friction.names) or "nothing"
    explain = "explain" if len(survey.friction.names) > 1 else "explains"
    return (
        f"Robots are compared joint by joint, without what {after} {explain}. If equals differ "
        f"normally, anybody stands out with a probability of {100 * FAMILY_WISE:g} %, all robots "
        "and joints together, in friction and in its change each; with heavier tails more often."
    )


def _of_probed(survey: Survey, probed: int) -> str:
    """Return how many robots were probed and how many false alarms are expected."""
    return f"of {probed} probed; by chance {survey.false_alarms:.2g}, nominally"


def _not_compared(survey: Survey) -> list[str]:
    """Return which robots were not compared, and why."""
    found: list[str] = []
    for which, what in ((survey.friction, "friction"), (survey.change, "change of friction")):
        if which is None:
            continue
        for name, rows in which.left_out.items():
            robots = ", ".join(survey.robots[k].robot for k in rows)
            found.append(f"{what} of {robots} is not compared: {name} is not known")
        for name in which.unused:
            found.append(
                f"{what} is compared without {name}: fewer than half of the robots tell it"
            )
    return found


def _missing(survey: Survey) -> str:
    return f"{len(survey.missing)} are not" if survey.missing else "all"


def _table(survey: Survey, out: list[tuple[SurveyedRobot, str]]) -> tuple[Table, ...]:
    if not out:
        return ()
    columns = tuple(Column(title, number=False) for title in ("robot", "age [years]", "why"))
    rows = tuple((Cell(one.robot, "warn"), Cell(_years(one)), Cell(why)) for one, why in out)
    return (Table("Changed since its champion, or unlike the others", columns, rows),)


def _sections(survey: Survey) -> list[Section]:
    found = []
    for key, which, title, y in (
        ("friction", survey.friction, "Friction", "friction, RMS [N·m]"),
        ("change", survey.change, "Change of friction", "share of champion's [1]"),
    ):
        values = [one.friction if key == "friction" else one.change for one in survey.robots]
        shown = [k for k, one in enumerate(values) if len(one) and np.isfinite(one).any()]
        if not shown:
            continue
        blocks = [over(survey, key, which, np.array([values[k] for k in shown]), shown, along, y)
                  for along in AXES]  # fmt: skip
        tables = [_trends(survey, which)] if which is not None and which.names else []
        lead = {
            "friction": "What each robot's model says is friction, along the fleet's trajectories.",
            "change": "Friction as a share of the champion's, by each robot's last probe.",
        }[key]
        found.append(Section(key, title, lead, (*tables, *(one for one in blocks if one))))
    return found


def over(
    survey: Survey, key: str, which: Comparison | None, y: FloatArray, shown: list[int], along: str,
    y_title: str,
) -> Figure | None:  # fmt: skip
    """A quantity over age or temperature, a panel per joint; None where that is not known.

    Args:
        survey: Of the fleet.
        key: `friction` or `change`.
        which: How the robots stand in it.
        y: (S, n) of the robots that are shown.
        shown: (S,) which they are.
        along: A key of `AXES`.
        y_title: Of the axis.
    """
    robots = [survey.robots[k] for k in shown]
    names = robots[0].joint_names
    if along == "age":
        x = np.repeat(np.array([one.age for one in robots])[:, None], len(names), axis=1)
    else:
        x = np.array([one.temperature for one in robots])
    if not np.isfinite(x).any():
        return None
    out = np.zeros(y.shape, dtype=bool) if which is None else which.outlying[shown]
    known = [one.robot for one in robots]
    panels = tuple(
        Panel(
            joint_title(j, name),
            AXES[along],
            y_title,
            (
                *_robots(x[:, j], y[:, j], out[:, j], known),
                *_trend(which, along, j, x[:, j], y[:, j]),
            ),
            alt=f"{y_title} of {name} over {AXES[along]}, a mark per robot",
        )
        for j, name in enumerate(names)
    )
    title = {"friction": "Friction", "change": "Change of friction"}[key]
    return Figure(f"{key}-{along}", f"{title} over {along}", "", panels, 0)


def _robots(x: FloatArray, y: FloatArray, out: BoolArray, names: list[str]) -> list[Curve]:
    looks = (
        (np.flatnonzero(~out), "robot", Look(colours.MEASURED, size=5)),
        (np.flatnonzero(out), "stands out", Look(colours.PREDICTED, symbol="diamond", size=9)),
    )
    return [
        Curve(name, x[rows], y[rows], "points", (), look, [names[i] for i in rows])
        for rows, name, look in looks
        if len(rows)
    ]


def _trend(
    which: Comparison | None, along: str, j: int, x: FloatArray, y: FloatArray
) -> list[Curve]:
    """The trend over one quantity through the middle of the fleet, the others at their mean."""
    if which is None or along not in which.names:
        return []
    told = np.isfinite(x) & np.isfinite(y)
    x, y = x[told], y[told]
    slope = which.slopes[which.names.index(along), j]
    middle = np.median(np.log(y) - slope * (x - x.mean()))
    ends = np.linspace(x.min(), x.max(), 20)
    values = np.exp(middle + slope * (ends - x.mean()))
    return [Curve("what is expected", ends, values, look=Look(colours.NEUTRAL, "dash"))]


def _trends(survey: Survey, which: Comparison | None) -> Table:
    assert which is not None
    columns = [Column("joint", number=False)]
    for name in which.names:
        columns += [Column(f"% {UNITS[name]}", name), Column("±", name)]
    rows = []
    for j, joint in enumerate(survey.joint_names):
        told = [
            text
            for k in range(len(which.names))
            for text in (f"{100 * which.slopes[k, j]:+.2f}", number(100 * which.errors[k, j], 2))
        ]
        rows.append(cells(joint_title(j, joint), *told))
    note = "± is one standard error of a robust regression of the logarithm."
    return Table("What age and temperature explain", tuple(columns), tuple(rows), note)


def _all(survey: Survey) -> Table:
    names = survey.joint_names
    columns = [Column("robot", number=False), Column("age [years]")]
    columns += [Column(f"J{j + 1}", "friction, RMS [N·m]") for j in range(len(names))]
    columns += [Column(f"J{j + 1}", "temperature [°C]") for j in range(len(names))]
    columns += [Column("last probe", number=False)]
    rows = []
    for one in survey.robots:
        friction = [number(v) for v in one.friction] or [UNKNOWN] * len(names)
        celsius = [f"{v:.1f}" if np.isfinite(v) else UNKNOWN for v in one.temperature]
        probe = one.probe.text if one.probe else UNKNOWN
        told = (one.robot, _years(one), *friction, *(celsius or [UNKNOWN] * len(names)), probe)
        rows.append(cells(*told))
    return Table("As it was measured", tuple(columns), tuple(rows))


def _years(one: SurveyedRobot) -> str:
    return f"{one.age:.1f}" if np.isfinite(one.age) else UNKNOWN
