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
from benchmarks.identification.table import Section, Table, joints, numbers, slug
from hil.data.dataset import Dataset
from hil.dynamics import RobotModel, load_model
from hil.errors import HilError

NAMES = {
    "ur10": "Universal Robots UR10 (CB3)",
    "panda": "Franka Emika Panda",
    "kr300": "KUKA KR 300 R2500 ultra",
    "tx40": "Stäubli TX40",
}

COMPARED = ("OLS", "WLS", "IRLS", "LMI", "LMI, weighted", "DiffNEA", DEFAULT)
QUICK = ("WLS", "LMI, weighted")


def measure(*, quick: bool = False) -> Section:
    """The default against the classical methods on every robot.

    Args:
        quick: The UR10 alone, few methods.
    """
    section = Section()
    for key in ("ur10",) if quick else recordings.SPLIT:
        if missing := recordings.missing(key):
            section.skipped[NAMES[key]] = missing
            continue
        train, test = recordings.SPLIT[key]()
        _robot(section, key, train, test, QUICK if quick else COMPARED)
    return section


def _robot(
    section: Section, key: str, train: Dataset, test: Dataset, compared: tuple[str, ...]
) -> None:
    robot = load_model(train.robot)
    wanted, absent = titles(compared)
    section.skipped |= {f"{NAMES[key]}, {title}": why for title, why in absent.items()}
    table = _table(key, train, test)
    means: dict[str, float] = {}
    for title in wanted:
        try:
            means[title] = _method(table, title, train, test, robot)
        except HilError as error:
            section.skipped[f"{NAMES[key]}, {title}"] = reason(error)
    section.tables.append(table)
    section.figures |= {slug(key, title, "percent"): value for title, value in means.items()}
    others = [value for title, value in means.items() if title != DEFAULT]
    if DEFAULT in means and others:
        section.ratios[f"{key}_default_to_best_classical"] = means[DEFAULT] / min(others)


def _table(key: str, train: Dataset, test: Dataset) -> Table:
    lasted = [sum(np.ptp(d["t"][rows]) for _, rows in d.slices()) for d in (train, test)]
    return Table(
        f"{NAMES[key]}: RMSE in % of the RMS effort, {lasted[1]:.1f} s behind the "
        f"{lasted[0]:.1f} s learnt from",
        ("method", *joints(test.n_joints), "mean", "filtered", "CPU s"),
        notes=[f"filtered: mean RMSE against the zero-phase filtered effort [{test.effort_unit}]"],
    )


def _method(table: Table, title: str, train: Dataset, test: Dataset, robot: RobotModel) -> float:
    found = fitted(title, [train], robot)
    told = errors(found.model, test)
    share = relative(told, test)
    mean = float(np.mean(share))
    table.add(
        title, numbers(share, ".1f"), f"{mean:.1f}", f"{told.mean('rmse_filtered'):.3f}",
        f"{found.cpu_s:.2f}",
    )  # fmt: skip
    return mean
