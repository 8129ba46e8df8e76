"""The map with which `hil import` reads an exported CSV file: trajectories as windows."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from hil.data import UPRIGHT, Dataset
from hil.importers.exporting.table import Table, flat_name, load_of
from hil.importers.import_map import QUANTITIES


def why_no_map(dataset: Dataset) -> str:
    """What a map cannot say of a dataset; empty where it says all."""
    if not any(one.kind == "trajectory" for one in dataset.conditions):
        return "imported rows are trajectories, and there are none"
    if tuple(dataset.gravity) != UPRIGHT:
        return "imported recordings count as made on an upright arm"
    if np.any(np.diff(dataset["t"]) <= 0):
        return "the clock began anew when the run was gone on with"
    return ""


def import_map(dataset: Dataset, table: Table) -> str:
    """YAML for `hil import FILE.csv --map FILE.map.yaml`."""
    windows = [
        {"rows": f"{rows.start + 1}:{rows.stop}", "payload": load_of(one.payload)}
        for one, rows in dataset.slices()
        if one.kind == "trajectory"
    ]
    document: dict[str, Any] = {
        "hil_map": 1,
        "description": f"samples of {table.about['source']}, written by hil export-data",
        "format": "csv",
        "header": True,
        "robot": dataset.robot,
        "joint_names": list(dataset.joint_names),
        "effort_kind": dataset.effort_kind,
        "serial": table.about["serial"],
        "columns": {"t": {"columns": [flat_name("t", "s")]}, **_quantities(dataset, table)},
        "windows": windows,
    }
    if dataset.drive_gains is not None:
        document["drive_gains_nm_a"] = dataset.drive_gains.tolist()
        document["drive_gains_source"] = dataset.drive_gains_source
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120)


def _quantities(dataset: Dataset, table: Table) -> dict[str, Any]:
    """Those of which every value is known."""
    found = {}
    for name in QUANTITIES:
        if name in table.columns and np.all(np.isfinite(table.columns[name])):
            unit = table.units[name]
            names = [flat_name(name, unit, j + 1) for j in range(dataset.n_joints)]
            found[name] = {"columns": names, "unit": unit}
    return found
