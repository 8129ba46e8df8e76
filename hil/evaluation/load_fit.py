"""The load of recordings: a stored model and sources in, the load out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import DataError, SpecError
from hil.data import Dataset
from hil.dynamics import CALIBRATED_SHARE, GAIN_SHARE
from hil.estimators import (
    Friction,
    PayloadEstimate,
    RobotEstimator,
    calibrated,
    estimate_payload,
    estimate_payload_at_rest,
    load_model_file,
    require_friction,
    require_one_load,
)
from hil.evaluation.fitting import usable_part
from hil.evaluation.validation import require_unseen, serial_notes
from hil.importers import load_source


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
        friction: See `estimate_payload`; at rest it is `auto`.
        bare: At rest: the same program with nothing mounted, nor declared.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            what `usual_gain_share` says of the model.

    Raises:
        DataError: The model or a source cannot be read, they do not belong together, the model was
            fitted to the source, or `bare` is one of the sources or declares a load.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or it or `bare` does not go with these.
    """
    require_friction(friction)
    stored = load_model_file(model)
    if not sources:
        raise DataError("no recording was given", hint="hil payload MODEL RECORDING")
    whole = [load_source(source) for source in sources]
    at_rest = _at_rest(stored, whole)
    _require_fitting_options(at_rest, friction, bare)
    parts = whole if at_rest else [usable_part(one, stored) for one in whole]
    data = Dataset.concatenate(parts)
    require_one_load(data)
    for source, part in zip(sources, parts, strict=True):
        require_unseen(stored, source, part)
    share = usual_gain_share(stored) if gain_share is None else gain_share
    with threadpool_limits(1):
        if at_rest:
            tare = _tare(sources, bare) if bare else None
            found = estimate_payload_at_rest(stored, data, bare=tare, gain_share=share)
        else:
            found = estimate_payload(stored, data, friction=friction).with_gains(share)
    serial = stored.training_.serial if stored.training_ else ""
    others = [note for one in (*sources, *bare) for note in serial_notes(serial, one)]
    notes = (*found.notes, *_notes(stored, data, gain_share))
    return replace(found, notes=notes, other_arm="; ".join(dict.fromkeys(others)))


def usual_gain_share(model: RobotEstimator) -> float:
    """Standard deviation of a model's drive gains [share of them], by where they come from."""
    if model.effort_kind_ == "torque":
        return 0.0
    return CALIBRATED_SHARE if calibrated(model.gains_source_) else GAIN_SHARE


def _require_fitting_options(at_rest: bool, friction: str, bare: Sequence[Path]) -> None:
    if bare and not at_rest:
        raise SpecError(
            "a weighing of the bare flange goes with a recording of an arm at rest, this is motion",
            hint="leave --bare out",
        )
    if at_rest and friction != "auto":
        raise SpecError(
            f"friction {friction} goes with motion, but this is an arm at rest: there two "
            "approaches cancel it",
            hint="leave --friction out",
        )


def _tare(sources: Sequence[Path], bare: Sequence[Path]) -> Dataset:
    """The weighings of the bare flange."""
    loaded = {source.resolve() for source in sources}
    parts = []
    for one in bare:
        if one.resolve() in loaded:
            raise DataError(
                f"{one} is to be weighed and is the bare flange as well",
                hint="--bare is another run of the same program, with nothing mounted",
            )
        part = load_source(one)
        declared = max(condition.payload.mass for condition in part.conditions)
        if declared > 0.0:
            # It would lean on a load that is not there, and come to rest otherwise.
            raise DataError(
                f"{one} is to be the bare flange, but declares {declared:g} kg to the controller",
                hint="run it again with `loads: [{mass_kg: 0}]` in its spec",
            )
        parts.append(part)
    return Dataset.concatenate(parts)


def _at_rest(model: RobotEstimator, parts: Sequence[Dataset]) -> bool:
    """Whether a load is to be told by its weight alone."""
    moving = any(condition.kind == "trajectory" for part in parts for condition in part.conditions)
    return "dwell" in model.series_kinds[0] or not moving


def _notes(model: RobotEstimator, data: Dataset, gain_share: float | None) -> Iterator[str]:
    if data.effort_kind != "current":
        return
    if gain_share is None:
        share = 100 * usual_gain_share(model)
        yield (
            f"± holds drive gains known to {share:.0f} % each; --gain-percent says how well they "
            "are, hil gains calibrates them"
        )
    declared = data.drive_gains
    if declared is not None and not np.allclose(declared, model.torque_scale_, rtol=1e-3):
        yield (
            "the model's drive gains count, not those the recording declares: "
            f"{model.gains_source_ or 'nobody said where they come from'}"
        )
