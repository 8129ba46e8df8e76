"""What a model remembers of the data it was fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import Dataset, Sketch

ROWS_ARRAY = "training_rows"
"""Array of the model file that holds the sketch."""


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """Enough to recognise the training data and to scale errors as they were scaled then.

    Attributes:
        sources: Names of the files or run directories, without their folders.
        samples: Rows.
        effort_std: (n,) standard deviation of the effort, the scale for NRMSE.
        rows: Fingerprints of the samples.
        serial: Serial number of the robot; empty when nobody said.
        payloads: The loads declared; None in older model files.
    """

    sources: tuple[str, ...]
    samples: int
    effort_std: FloatArray
    rows: Sketch
    serial: str = ""
    payloads: tuple[Payload, ...] | None = None

    @staticmethod
    def of(dataset: Dataset) -> Training:
        """What there is to remember of a dataset."""
        paths = dict.fromkeys(condition.source for condition in dataset.conditions)
        names = tuple(Path(path).name for path in paths if path)
        std = np.asarray(np.std(dataset["effort"], axis=0))
        loads = tuple(dict.fromkeys(condition.payload for condition in dataset.conditions))
        rows = Sketch.of(dataset)
        return Training(names, len(dataset), std, rows, payloads=loads)

    def facts(self) -> dict[str, Any]:
        """For `model.json`; the fingerprints go into its arrays."""
        return {
            "sources": list(self.sources),
            "samples": self.samples,
            "serial": self.serial,
            "payloads": self.payloads
            and [[load.mass, *load.com, *load.inertia] for load in self.payloads],
            "effort_std": self.effort_std,
            "every_row_kept": self.rows.complete,
        }

    @staticmethod
    def restored(facts: Mapping[str, Any], arrays: Mapping[str, Any]) -> Training:
        """Inverse of `facts`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or garbled.
        """
        loads = facts.get("payloads")
        return Training(
            tuple(facts["sources"]),
            int(facts["samples"]),
            np.array(facts["effort_std"], dtype=np.float64),
            Sketch(np.asarray(arrays[ROWS_ARRAY]), bool(facts["every_row_kept"])),
            str(facts["serial"]),
            None if loads is None else tuple(_load(numbers) for numbers in loads),
        )


def _load(numbers: Sequence[float]) -> Payload:
    mass, x, y, z, *inertia = (float(number) for number in numbers)
    xx, yy, zz, xy, xz, yz = inertia
    return Payload(mass, (x, y, z), (xx, yy, zz, xy, xz, yz))
