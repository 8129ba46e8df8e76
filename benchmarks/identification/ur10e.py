"""The UR10e: four trajectories to learn from, another one two weeks later to be judged on."""

from __future__ import annotations

import numpy as np

from benchmarks.identification import recordings
from benchmarks.identification.methods import (
    DEFAULT,
    errors,
    fitted,
    left_out,
    reason,
    titles,
)
from benchmarks.identification.table import Section, Table, joints, numbers, slug
from hil.core.errors import HilError
from hil.data.dataset import Dataset
from hil.dynamics import load_model
from hil.evaluation import Errors

ANCHORS = {"OLS": 0.1470, "WLS": 0.1450, "IRLS": 0.1451, "LMI, weighted": 0.1448}
"""Mean raw RMSE [A] of the same methods by other code, measured once outside this project."""

WITHIN = 0.02
"""How far from its anchor a method may come out."""

GOAL_FILTERED_A, GOAL_RAW_A, GOAL_CPU_S = 0.060, 0.108, 5.0
"""Of the default model on 14h50."""

DEFAULTS_BAND = {"unit": "hz", "velocity": 11.0, "acceleration": 11.0, "effort": 17.6}
"""Filters that the default chooses by itself on these recordings; the others have those of the
anchors, 0.15 and 0.20 of the Nyquist frequency."""

CHOICES: dict[str, tuple[tuple[str, dict[str, object]], ...]] = {
    "WLS": (
        ("sign_width .005", {"sign_width": 0.005}),
        ("sign_width .02", {"sign_width": 0.02}),
        ("default's filters", {"filters": DEFAULTS_BAND}),
    ),
    "IRLS": (("loss tukey", {"loss": "tukey"}),),
    "LMI, weighted": (
        ("prior 0.1", {"prior": 0.1}),
        ("prior 10", {"prior": 10.0}),
        ("default's filters", {"filters": DEFAULTS_BAND}),
        ("columns filtered too", {"filter_columns": True}),
    ),
    DEFAULT: (
        ("filters of the others", {"filters": {}}),
        ("shapes not fitted", {"fit_shapes": False}),
        ("links unconstrained", {"consistent": False}),
    ),
}
"""What could have been chosen instead, judged on the training trajectories alone."""

QUICK = ("WLS", DEFAULT)


def measure(*, quick: bool = False) -> Section:
    """Every method on 14h50, and its choices on the training trajectories.

    Args:
        quick: Few methods, one training trajectory, nothing left out.
    """
    section = Section()
    if missing := recordings.missing("ur10e"):
        section.skipped["UR10e"] = missing
        return section
    robot, train = load_model("ur10e"), recordings.ur10e_train()
    held = recordings.ur10e_validation()
    wanted, absent = titles(QUICK) if quick else titles()
    section.skipped |= {f"UR10e, {title}": why for title, why in absent.items()}
    table = _table(len(train[:1]) if quick else len(train), held.n_joints)
    filtered = Table(
        "UR10e, the same against the zero-phase filtered current [A]",
        ("method", *joints(held.n_joints), "mean"),
    )
    last: Errors | None = None
    for title in wanted:
        try:
            score = float("nan") if quick else left_out(title, train, robot)
            found = fitted(title, train[:1] if quick else train, robot)
            last = errors(found.model, held)
        except HilError as error:
            section.skipped[f"UR10e, {title}"] = reason(error)
            continue
        _tell(section, table, title, last, found.cpu_s, score)
        filtered.add(title, numbers(last.rmse_filtered), f"{last.mean('rmse_filtered'):.4f}")
    if last is not None:
        mean = f"{last.mean('noise_floor'):.4f}"
        table.add("noise", numbers(last.noise_floor), mean, "", "", "")
    section.tables += [table, filtered]
    if not quick:
        _anchored(section)
        section.tables.append(_choices(train, wanted, section))
    return section


def _table(trajectories: int, n: int) -> Table:
    return Table(
        f"UR10e: RMSE on raw current [A], {trajectories} trajectories learnt from, judged on 14h50",
        ("method", *joints(n), "mean", "filtered", "left out", "CPU s"),
        notes=[
            "left out: mean filtered RMSE on each training trajectory by a model of the others;"
            " choices are made by it alone",
            "noise: raw minus zero-phase filtered current (Butterworth 5, 0.20 of Nyquist)",
        ],
    )


def _tell(
    section: Section, table: Table, title: str, found: Errors, cpu_s: float, score: float
) -> None:
    raw, filtered = found.mean("rmse_raw"), found.mean("rmse_filtered")
    told = "" if np.isnan(score) else f"{score:.4f}"
    table.add(title, numbers(found.rmse_raw), f"{raw:.4f}", f"{filtered:.4f}", told, f"{cpu_s:.2f}")
    key = slug("ur10e", title)
    section.figures |= {f"{key}_raw_a": raw, f"{key}_filtered_a": filtered, f"{key}_cpu_s": cpu_s}
    if not np.isnan(score):
        section.figures[f"{key}_left_out_a"] = score
    if title == DEFAULT:
        section.ratios |= {
            "ur10e_default_filtered_to_goal": filtered / GOAL_FILTERED_A,
            "ur10e_default_raw_to_goal": raw / GOAL_RAW_A,
            "ur10e_default_cpu_to_goal": cpu_s / GOAL_CPU_S,
        }


def _anchored(section: Section) -> None:
    table = Table(
        "UR10e: the same methods by other code [A], mean raw RMSE",
        ("method", "anchor", "here", "deviation", "within 2 %"),
    )
    for title, anchor in ANCHORS.items():
        here = section.figures.get(slug("ur10e", title, "raw_a"))
        if here is not None:
            off = here / anchor - 1.0
            within = "yes" if abs(off) <= WITHIN else "NO"
            table.add(title, f"{anchor:.4f}", f"{here:.4f}", f"{100 * off:+.2f} %", within)
            section.ratios[slug("ur10e", title, "to_anchor")] = here / anchor
    section.tables.append(table)


def _choices(train: list[Dataset], wanted: list[str], section: Section) -> Table:
    robot = load_model("ur10e")
    table = Table(
        "UR10e: choices, judged by leaving out each training trajectory in turn [A]",
        ("method", "choice", "left out"),
    )
    for title, options in CHOICES.items():
        if title not in wanted:
            continue
        above = section.figures.get(slug("ur10e", title, "left_out_a"), float("nan"))
        table.add(title, "as above", f"{above:.4f}")
        for told, changed in options:
            try:
                table.add(title, told, f"{left_out(title, train, robot, **changed):.4f}")
            except HilError as error:
                table.add(title, told, reason(error))
    return table
