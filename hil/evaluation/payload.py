"""The payload of recordings: a stored model and sources in, the payload out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import AnyPath, DataError, SpecError, path_of, paths_of
from hil.data import Dataset
from hil.dynamics import CALIBRATED_SHARE, GAIN_SHARE
from hil.estimators import (
    Friction,
    PayloadEstimate,
    RobotEstimator,
    calibrated,
    estimate_payload_at_rest,
    load_model_file,
    require_friction,
    require_one_load,
)
from hil.estimators import estimate_payload as payload_in_motion
from hil.evaluation.fitting import usable_part
from hil.evaluation.validation import require_unseen, serial_notes
from hil.importers import load_source


def estimate_payload(
    model: AnyPath,
    sources: AnyPath | Iterable[AnyPath],
    *,
    friction: str = "auto",
    bare: AnyPath | Iterable[AnyPath] = (),
    gain_share: float | None = None,
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a saved model of the arm.

    A recording of an arm at rest tells mass and centre of mass, one of motion inertia as well.
    Where no source holds a trajectory, or the model knows only an arm at rest, the load is told by
    its weight alone (`estimate_payload_at_rest`).

    Args:
        model: Its folder.
        sources: Run directories or MCAP files recorded with that load, or just one.
        friction: What of the model's friction may differ on that day: nothing (`model`), an
            `offset` per joint, or an offset and a factor (`scale`); `auto` lets the recording
            choose, by stretches that are left out in turn. At rest it is `auto`.
        bare: At rest: the same program run with nothing mounted, nor declared; much smaller errors.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            what `usual_gain_share` says: 0.05, or 0.01 where they were calibrated (`hil gains`);
            torques have none.

    Raises:
        DataError: A source cannot be read, is of another robot, or was fitted to; or
            `bare` is one of the sources or declares a load.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or `bare` was given with motion.
    """
    folder, recordings, bare_flange = path_of(model), paths_of(sources), paths_of(bare)
    require_friction(friction)
    stored = load_model_file(folder)
    if not recordings:
        raise DataError("no recording was given", hint="hil payload MODEL RECORDING")
    whole = [load_source(source) for source in recordings]
    at_rest = _at_rest(stored, whole)
    _require_fitting_options(at_rest, friction, bare_flange)
    parts = whole if at_rest else [usable_part(one, stored) for one in whole]
    data = Dataset.concatenate(parts)
    require_one_load(data)
    for source, part in zip(recordings, parts, strict=True):
        require_unseen(stored, source, part)
    share = usual_gain_share(stored) if gain_share is None else gain_share
    with threadpool_limits(1):
        if at_rest:
            tare = _tare(recordings, bare_flange) if bare_flange else None
            found = estimate_payload_at_rest(stored, data, bare=tare, gain_share=share)
        else:
            way = cast("Friction | Literal['auto']", friction)
            found = payload_in_motion(stored, data, friction=way).with_gains(share)
    serial = stored.training_.serial if stored.training_ else ""
    others = [note for one in (*recordings, *bare_flange) for note in serial_notes(serial, one)]
    notes = (*found.notes, *_notes(stored, data, gain_share))
    return replace(found, notes=notes, other_arm="; ".join(dict.fromkeys(others)))


def _at_rest(model: RobotEstimator, parts: Sequence[Dataset]) -> bool:
    """Whether a load is to be told by its weight alone."""
    moving = any(condition.kind == "trajectory" for part in parts for condition in part.conditions)
    return "dwell" in model.series_kinds[0] or not moving


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


def usual_gain_share(model: RobotEstimator) -> float:
    """Standard deviation of a model's drive gains [share of them], by where they come from."""
    if model.effort_kind_ == "torque":
        return 0.0
    return CALIBRATED_SHARE if calibrated(model.gains_source_) else GAIN_SHARE
