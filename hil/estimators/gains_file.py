"""Drive gains in a file: what `hil gains -o` writes, and `hil fit --gains` fits with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray, RecordingError, SpecError, read_source
from hil.data import Dataset

KEY, SOURCE_KEY = "drive_gains_nm_a", "drive_gains_source"


@dataclass(frozen=True, slots=True, eq=False)
class DriveGains:
    """Torque per current of every joint.

    Attributes:
        values: (n,) [N·m/A], above 0.
        source: Where they come from.
    """

    values: FloatArray
    source: str

    def of(self, dataset: Dataset) -> Dataset:
        """The recording with these gains instead of those it declares.

        Raises:
            DataError: They are of another number of joints, or the recording holds torques.
        """
        if dataset.effort_kind != "current":
            raise DataError(
                "drive gains turn currents into torques, but the recording holds torques",
                hint="leave the gains out",
            )
        if len(self.values) != dataset.n_joints:
            raise DataError(
                f"{len(self.values)} drive gains were given for {dataset.n_joints} joints",
                hint="give one per joint, base to flange",
            )
        return replace(dataset, drive_gains=self.values, drive_gains_source=self.source)


def read_gains(path: Path) -> DriveGains:
    """The gains in a YAML file: those of `hil gains -o`, of an import map, or of your own.

    Raises:
        SpecError: The file cannot be read, or has no `drive_gains_nm_a` of positive numbers.
    """
    found = read_source(path).data
    told = found.get(KEY) if isinstance(found, dict) else None
    numbers = told if isinstance(told, list) else []
    if not numbers or not all(_is_gain(number) for number in numbers):
        raise SpecError(
            f"{path}: holds no {KEY}: a list of numbers above 0, one per joint",
            hint="write it with: hil gains SOURCE -o gains.yaml",
        )
    assert isinstance(found, dict)
    source = str(found.get(SOURCE_KEY) or path.name)
    return DriveGains(np.array(numbers, dtype=np.float64), source)


def _is_gain(number: object) -> bool:
    if isinstance(number, bool) or not isinstance(number, int | float):
        return False
    return bool(np.isfinite(number)) and number > 0


def write_gains(path: Path, lines: Sequence[str]) -> None:
    """Write the lines of `Gains.yaml_lines`.

    Raises:
        DataError: There are none: a joint's gain is not known.
        RecordingError: The file exists already.
    """
    if not lines:
        raise DataError(
            "the gains of some joints are not known, so no file was written",
            hint="declare gains in the import map; joints that do not tell keep those",
        )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
    except FileExistsError:
        raise RecordingError(f"{path} exists already", hint="choose another -o") from None
