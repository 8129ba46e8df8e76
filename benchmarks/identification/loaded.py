"""2.805 kg at the UR10e's flange: found in one half of a recording, tested on the other.

The drive gains come from the controller's own currents and torques in the unloaded recording, so
nothing weighed enters; literature gains are shown beside. The arm's model has not seen the load.
"""

from __future__ import annotations

import numpy as np

from benchmarks.identification import recordings
from benchmarks.identification.methods import DEFAULT, fitted, reason, titles, with_gains
from benchmarks.identification.table import Section, Table, slug
from hil.core.errors import HilError
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.dynamics import load_model
from hil.estimators.drive_gains import controller_gains
from hil.estimators.payload import HalfTested, payload_halves

TRUE_KG = 2.805
GOAL_RAW_A, GOAL_MASS_SHARE = 0.125, 0.05
COMPARED = ("WLS", "LMI, weighted", "DiffNEA", DEFAULT)


def measure(*, quick: bool = False) -> Section:
    """Identify the payload by several methods, with identified and with published drive gains.

    Args:
        quick: One method, identified gains only.
    """
    section = Section()
    if missing := recordings.missing("ur10e"):
        section.skipped["load"] = missing
        return section
    unloaded, loaded = recordings.ur10e_validation(), recordings.ur10e_loaded()
    gains, declared = controller_gains(unloaded).gain, unloaded.drive_gains
    assert declared is not None
    table = _table(gains)
    wanted, absent = titles(("WLS",) if quick else COMPARED)
    section.skipped |= {f"load, {title}": why for title, why in absent.items()}
    cases = {"controller": gains} | ({} if quick else {"literature": declared})
    for title in wanted:
        for source, values in cases.items():
            _case(section, table, title, source, [with_gains(unloaded, values, source)],
                  with_gains(loaded, values, source))  # fmt: skip
    if not quick and DEFAULT in wanted:
        pooled = [with_gains(part, gains, "controller") for part in recordings.ur10e_train()]
        _case(section, table, DEFAULT, "controller, 4 pooled", pooled,
              with_gains(loaded, gains, "controller"))  # fmt: skip
    section.tables.append(table)
    return section


def _table(gains: FloatArray) -> Table:
    listed = " ".join(f"{gain:.2f}" for gain in gains)
    return Table(
        f"UR10e with {TRUE_KG} kg: load from one half of 14h50Load, raw mean RMSE on the other [A]",
        ("method", "gains", "ignored", "fitted", "mass kg", "mass error"),
        notes=[
            "both ways, first half fitted / second half fitted; the arm's model is of 14h50 "
            "without load, or of the four trajectories pooled",
            f"gains from the controller's currents and torques: {listed} N·m/A",
        ],
    )


def _case(
    section: Section,
    table: Table,
    title: str,
    source: str,
    train: list[Dataset],
    loaded: Dataset,
) -> None:
    try:
        model = fitted(title, train, load_model("ur10e")).model
        halves = payload_halves(model, loaded)
    except HilError as error:
        section.skipped[f"load, {title}, {source}"] = reason(error)
        return
    masses = [half.estimate.payload.mass for half in halves]
    off = [mass / TRUE_KG - 1.0 for mass in masses]
    table.add(
        title, source, _both([_ignored(half) for half in halves], ".3f"),
        _both([half.mean_raw for half in halves], ".4f"), _both(masses, ".3f"),
        " / ".join(f"{100 * share:+.1f} %" for share in off),
    )  # fmt: skip
    key = slug("load", title, source)
    section.figures |= {
        f"{key}_raw_a": float(np.mean([half.mean_raw for half in halves])),
        f"{key}_mass_kg": float(np.mean(masses)),
    }
    if title == DEFAULT and source == "controller":
        worst = max(half.mean_raw for half in halves)
        section.ratios["load_default_raw_to_goal"] = worst / GOAL_RAW_A
        section.ratios["load_default_mass_error_to_goal"] = max(map(abs, off)) / GOAL_MASS_SHARE


def _ignored(half: HalfTested) -> float:
    return float(np.mean(half.rmse_ignored))


def _both(values: list[float], form: str) -> str:
    return " / ".join(format(value, form) for value in values)
