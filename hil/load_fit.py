"""The load of recordings: a stored model and sources in, the load out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from hil.data.dataset import Dataset
from hil.data.load import load_source
from hil.errors import DataError
from hil.fitting import usable_part
from hil.identify.base import RobotEstimator
from hil.identify.model_file import load_model_file
from hil.identify.payload_estimate import PayloadEstimate
from hil.identify.payload_fit import estimate_payload
from hil.identify.payload_problem import Friction
from hil.validation import require_unseen, serial_notes


def payload_of_sources(
    model: Path, sources: Sequence[Path], friction: Friction | Literal["auto"] = "auto"
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a stored model of the arm.

    Args:
        model: Its folder.
        sources: Runs or files recorded with the same load.
        friction: See `estimate_payload`.

    Raises:
        DataError: The model or a source cannot be read, they do not belong together, or the model
            was fitted to the source.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction.
    """
    stored = load_model_file(model)
    if not sources:
        raise DataError("no recording was given", hint="hil payload MODEL RECORDING")
    parts = [usable_part(load_source(source), stored) for source in sources]
    for source, part in zip(sources, parts, strict=True):
        require_unseen(stored, source, part)
    data = Dataset.concatenate(parts)
    with threadpool_limits(1):
        found = estimate_payload(stored, data, friction=friction)
    return replace(found, notes=(*found.notes, *_notes(stored, data, sources)))


def _notes(model: RobotEstimator, data: Dataset, sources: Sequence[Path]) -> Iterator[str]:
    serial = model.training_.serial if model.training_ else ""
    for source in sources:
        yield from serial_notes(serial, source)
    if data.effort_kind != "current":
        return
    declared = data.drive_gains
    if declared is not None and not np.allclose(declared, model.torque_scale_, rtol=1e-3):
        yield (
            "the model's drive gains count, not those the recording declares: "
            f"{model.gains_source_ or 'nobody said where they come from'}"
        )
