"""A dataset as columns: one row per sample, units in the names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hil.arms import Payload
from hil.core import read_json, sha256_of
from hil.data import Conditions, Dataset
from hil.importers.load import serial_of
from hil.recording import package_versions, utc_now

Values: TypeAlias = NDArray[Any]

EXPORT_FORMAT = 1

UNITS = {
    "t": "s", "q": "rad", "qd": "rad/s", "qdd": "rad/s²", "temperature": "°C", "q_target": "rad",
    "qd_target": "rad/s", "qdd_target": "rad/s²", "torque_target": "N·m",
}  # fmt: skip
_IN_NAMES = {
    "s": "s", "rad": "rad", "rad/s": "rad_s", "rad/s²": "rad_s2", "°C": "c", "A": "a", "N·m": "nm",
}  # fmt: skip

_OF_RUN = (
    "uid", "started", "operator", "host", "experiment", "robot_name", "seed", "spec_hash",
    "plan_hash", "git", "packages", "occasion",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Samples and labels.

    Attributes:
        columns: Dataset column → (N,) or (N, n).
        labels: What the robot did in each row → (N,).
        units: Dataset column → unit.
        about: Where all of it comes from; strict JSON.
    """

    columns: Mapping[str, Values]
    labels: Mapping[str, Values]
    units: Mapping[str, str]
    about: Mapping[str, Any]

    def flat(self) -> list[tuple[str, str, Values]]:
        """Name, unit and values of columns with one value a row: `t_s`, `q_1_rad`, … `kind`."""
        found: list[tuple[str, str, Values]] = []
        for name, values in self.columns.items():
            unit = self.units[name]
            if values.ndim == 1:
                found.append((flat_name(name, unit), unit, values))
            else:
                found += [
                    (flat_name(name, unit, j + 1), unit, values[:, j])
                    for j in range(values.shape[1])
                ]
        return found + [(name, "", values) for name, values in self.labels.items()]


def flat_name(column: str, unit: str, joint: int = 0) -> str:
    """Name of one joint's values (from 1), or of a column without joints."""
    return "_".join(filter(None, (column, str(joint or ""), _IN_NAMES[unit])))


def table_of(dataset: Dataset, source: Path) -> Table:
    """The columns of a dataset, its labels, and what is known of its source.

    Raises:
        DataError: Documents of the source cannot be read.
    """
    units = UNITS | dict.fromkeys(("effort", "effort_target"), dataset.effort_unit)
    columns = {name: dataset[name] for name in ("t", *sorted(set(dataset.columns) - {"t"}))}
    units = {name: units[name] for name in columns}
    about = _about(dataset, source) | {"units": units}
    return Table(columns, _labels(dataset), units, about)


def _labels(dataset: Dataset) -> dict[str, Values]:
    series = dataset.series_index()
    kept: dict[str, list[Any]] = {
        name: [getattr(one, name) for one in dataset.conditions]
        for name in ("kind", "trajectory", "pose", "approach", "load", "attempt")
    }
    kept["settled"] = [int(one.settled) for one in dataset.conditions]
    kept["load_mass_kg"] = [one.payload.mass for one in dataset.conditions]
    return {"series": series} | {name: np.array(told)[series] for name, told in kept.items()}


def _about(dataset: Dataset, source: Path) -> dict[str, Any]:
    return {
        "hil_export": EXPORT_FORMAT,
        "hil": package_versions().get("hil", ""),
        "exported": utc_now(),
        "source": source.resolve().name,
        "recordings_sha256": _digests(source),
        "run": _run(source),
        "robot": dataset.robot,
        "serial": serial_of(source),
        "joint_names": list(dataset.joint_names),
        "effort_kind": dataset.effort_kind,
        "drive_gains_nm_a": None if dataset.drive_gains is None else dataset.drive_gains.tolist(),
        "drive_gains_source": dataset.drive_gains_source,
        "gravity_m_s2": list(dataset.gravity),
        "series": [_series(one, rows) for one, rows in dataset.slices()],
    }


def _series(one: Conditions, rows: slice) -> dict[str, Any]:
    return {"id": one.id, "rows": [rows.start, rows.stop], "payload": load_of(one.payload)}


def load_of(load: Payload) -> dict[str, Any]:
    """A load as documents and maps have it."""
    return {"mass_kg": load.mass, "com_m": list(load.com), "inertia_kgm2": list(load.inertia)}


def _run(source: Path) -> dict[str, Any] | None:
    if not source.is_dir():
        return None
    start = read_json(source / "start.json")
    return {key: start[key] for key in _OF_RUN if key in start}


def _digests(source: Path) -> dict[str, str]:
    files = sorted(source.glob("recording/*.mcap*")) if source.is_dir() else [source]
    return {file.name: sha256_of(file) for file in files}
