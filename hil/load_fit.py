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
from hil.dynamics.weighing import GAIN_SHARE
from hil.errors import DataError, SpecError
from hil.fitting import usable_part
from hil.identify.base import RobotEstimator
from hil.identify.model_file import load_model_file
from hil.identify.payload_estimate import PayloadEstimate
from hil.identify.payload_fit import estimate_payload, require_one_load
from hil.identify.payload_problem import Friction
from hil.identify.payload_rest import estimate_payload_at_rest
from hil.validation import require_unseen, serial_notes


def payload_of_sources(
    model: Path,
    sources: Sequence[Path],
    friction: Friction | Literal["auto"] = "auto",
    *,
    bare: Sequence[Path] = (),
    gain_share: float | None = None,
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a stored model of the arm.

    Where no source holds a trajectory, or the model knows only an arm at rest, the load is told by
    its weight alone (`estimate_payload_at_rest`).

    Args:
        model: Its folder.
        sources: Runs or files recorded with the same load.
        friction: See `estimate_payload`.
        bare: At rest: the same program with nothing mounted.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            that of `hil.dynamics.weighing` at rest, and 0 in motion.

    Raises:
        DataError: The model or a source cannot be read, they do not belong together, or the model
            was fitted to the source.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or `bare` was given with motion.
    """
    stored = load_model_file(model)
    if not sources:
        raise DataError("no recording was given", hint="hil payload MODEL RECORDING")
    whole = [load_source(source) for source in sources]
    at_rest = _at_rest(stored, whole)
    if bare and not at_rest:
        raise SpecError(
            "a weighing of the bare flange goes with a recording of an arm at rest, this is motion",
            hint="leave --bare out",
        )
    parts = whole if at_rest else [usable_part(one, stored) for one in whole]
    for source, part in zip(sources, parts, strict=True):
        require_unseen(stored, source, part)
    data = Dataset.concatenate(parts)
    with threadpool_limits(1):
        if at_rest:
            require_one_load(data)
            tare = Dataset.concatenate([load_source(one) for one in bare]) if bare else None
            share = GAIN_SHARE if gain_share is None else gain_share
            found = estimate_payload_at_rest(stored, data, bare=tare, gain_share=share)
        else:
            found = estimate_payload(stored, data, friction=friction).with_gains(gain_share or 0.0)
    return replace(found, notes=(*found.notes, *_notes(stored, data, (*sources, *bare))))


def _at_rest(model: RobotEstimator, parts: Sequence[Dataset]) -> bool:
    """Whether a load is to be told by its weight alone."""
    moving = any(condition.kind == "trajectory" for part in parts for condition in part.conditions)
    return "dwell" in model.series_kinds[0] or not moving


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
