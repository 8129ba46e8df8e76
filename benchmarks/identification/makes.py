"""Other makes of robot: one recording each, the earlier part to learn from, the rest to judge."""

from __future__ import annotations

import numpy as np

from benchmarks.identification import recordings
from benchmarks.identification.methods import (
    DEFAULT,
    errors,
    fitted,
    reason,
    relative,
    titles,
)
from benchmarks.identification.parts import cut, in_turn
from benchmarks.identification.table import Section, Table, joints, numbers, slug
from hil.core.errors import HilError
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.dynamics import RobotModel, load_model
from hil.evaluation import Errors

NAMES = {
    "ur10": "Universal Robots UR10 (CB3)",
    "panda": "Franka Emika Panda",
    "kr300": "KUKA KR 300 R2500 ultra",
    "tx40": "Stäubli TX40",
}

COMPARED = ("OLS", "WLS", "IRLS", "LMI", "LMI, weighted", "DiffNEA", DEFAULT)
QUARTERS = 4
QUICK = ("WLS", "LMI, weighted")


def measure(*, quick: bool = False) -> Section:
    """Compare the default with the classical methods on every robot.

    Args:
        quick: The UR10 alone, few methods.
    """
    section = Section()
    for key in ("ur10",) if quick else recordings.ONCE:
        if missing := recordings.missing(key):
            section.skipped[NAMES[key]] = missing
        else:
            _robot(section, key, QUICK if quick else COMPARED, turns=not quick)
    return section


def _robot(section: Section, key: str, compared: tuple[str, ...], *, turns: bool) -> None:
    whole = recordings.whole(key)
    train, test = cut(whole)
    robot = load_model(whole.robot)
    wanted, absent = titles(compared)
    section.skipped |= {f"{NAMES[key]}, {title}": why for title, why in absent.items()}
    table = _table(key, train, test)
    for title in wanted:
        try:
            later = _later(title, train, test, robot)
            each = _in_turn(title, whole, robot) if turns else float("nan")
        except HilError as error:
            section.skipped[f"{NAMES[key]}, {title}"] = reason(error)
            continue
        share, told, cpu_s = later
        mean = float(np.mean(share))
        table.add(
            title, numbers(share, ".1f"), f"{mean:.1f}", f"{told.mean('rmse_filtered'):.3f}",
            f"{each:.1f}" if turns else "", f"{cpu_s:.2f}",
        )  # fmt: skip
        section.figures[slug(key, title, "percent")] = mean
        if turns:
            section.figures[slug(key, title, "in turn percent")] = each
    section.tables.append(table)
    _compare(section, key, [title for title in wanted if title != DEFAULT])


def _compare(section: Section, key: str, classical: list[str]) -> None:
    """Return the mean error of the default divided by that of the best classical method."""
    for way in ("percent", "in turn percent"):
        ours = section.figures.get(slug(key, DEFAULT, way))
        others = [section.figures.get(slug(key, title, way)) for title in classical]
        known = [value for value in others if value is not None]
        if ours is not None and known:
            name = "default_to_best" if way == "percent" else "default_to_best_in_turn"
            section.ratios[slug(key, name)] = ours / min(known)


def _table(key: str, train: Dataset, test: Dataset) -> Table:
    lasted = [sum(np.ptp(d["t"][rows]) for _, rows in d.slices()) for d in (train, test)]
    return Table(
        f"{NAMES[key]}: RMSE in % of the RMS effort, {lasted[1]:.1f} s behind the "
        f"{lasted[0]:.1f} s learnt from",
        ("method", *joints(test.n_joints), "mean", "filtered", "in turn", "CPU s"),
        notes=[
            f"filtered: mean RMSE against the zero-phase filtered effort [{test.effort_unit}]; "
            f"in turn: mean % over {QUARTERS} contiguous parts, each by a model of the others"
        ],
    )


def _later(
    title: str, train: Dataset, test: Dataset, robot: RobotModel
) -> tuple[FloatArray, Errors, float]:
    found = fitted(title, [train], robot)
    told = errors(found.model, test)
    return relative(told, test), told, found.cpu_s


def _in_turn(title: str, whole: Dataset, robot: RobotModel) -> float:
    """Mean over the joints of the RMS over all parts."""
    squares, rows = np.zeros(whole.n_joints), 0
    for train, test in in_turn(whole, QUARTERS):
        told = errors(fitted(title, [train], robot).model, test)
        squares += told.rmse_raw**2 * len(test)
        rows += len(test)
    size = np.sqrt(np.mean(whole["effort"] ** 2, axis=0))
    return float(np.mean(100.0 * np.sqrt(squares / rows) / size))
