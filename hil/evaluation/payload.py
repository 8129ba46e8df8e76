"""Payload identification with a stored model, for recordings on disk."""

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
    """Return the payload that was mounted during recordings, identified with a stored arm model.

    Static poses determine the mass and the centre of mass; a motion also determines the inertia. If
    no source contains a trajectory, or if the model is only valid for a static arm, only the mass
    and the centre of mass are identified (`estimate_payload_at_rest`).

    Args:
        model: Model folder.
        sources: One or several run directories or MCAP files, all recorded with one payload.
        friction: Friction parameters to re-estimate: no parameter (`model`), an offset per joint
            (`offset`), or an offset and a factor per joint (`scale`). The value `auto` chooses the
            treatment by cross-validation over stretches of the recording. For static poses, only
            the treatment `auto` is allowed.
        bare: Recordings of the same program without mounted or declared payload; only for static
            poses, for which they strongly reduce the errors.
        gain_share: Standard deviation of a drive gain, as a share of the gain. If None,
            `usual_gain_share` defines the share: 0.05, or 0.01 for calibrated gains (`hil
            drive-gains`). For torque data, `gain_share` is not used, because torques need no drive
            gains.

    Raises:
        DataError: A source cannot be read, is a recording of a different robot, or contains
            training data of the model. A recording in `bare` is also among the sources, or declares
            a payload.
        FitError: The recording does not determine the payload sufficiently.
        SpecError: The friction treatment is unknown, or `bare` was passed although the recording
            contains a motion.
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
    """Return whether the payload is identified from static poses alone."""
    moving = any(condition.kind == "trajectory" for part in parts for condition in part.conditions)
    return "dwell" in model.series_kinds[0] or not moving


def _require_fitting_options(at_rest: bool, friction: str, bare: Sequence[Path]) -> None:
    if bare and not at_rest:
        raise SpecError(
            "a recording of the bare flange is used only with static poses, but this recording "
            "contains motion",
            hint="leave out --bare",
        )
    if at_rest and friction != "auto":
        raise SpecError(
            f"friction {friction} is for motion, but this recording contains static poses, where "
            "the two approach directions cancel friction",
            hint="leave out --friction",
        )


def _tare(sources: Sequence[Path], bare: Sequence[Path]) -> Dataset:
    """Return the recordings of the bare flange, combined into one dataset."""
    loaded = {source.resolve() for source in sources}
    parts = []
    for one in bare:
        if one.resolve() in loaded:
            raise DataError(
                f"{one} is passed both with payload and as the bare flange",
                hint="for --bare, pass a different run of the same program without payload",
            )
        part = load_source(one)
        declared = max(condition.payload.mass for condition in part.conditions)
        if declared > 0.0:
            # The controller would compensate a payload that is not mounted, which changes the way
            # in which the joints come to rest.
            raise DataError(
                f"{one} is passed as the bare flange, but declares {declared:g} kg to the "
                "controller",
                hint="repeat the run with `loads: [{mass_kg: 0}]` in its spec",
            )
        parts.append(part)
    return Dataset.concatenate(parts)


def _notes(model: RobotEstimator, data: Dataset, gain_share: float | None) -> Iterator[str]:
    if data.effort_kind != "current":
        return
    if gain_share is None:
        share = 100 * usual_gain_share(model)
        yield (
            f"± includes an uncertainty of {share:.0f} % of each drive gain; set it with "
            "--gain-percent, calibrate the gains with hil drive-gains"
        )
    declared = data.drive_gains
    if declared is not None and not np.allclose(declared, model.torque_scale_, rtol=1e-3):
        yield (
            "the drive gains of the model are used, not those declared in the recording; their "
            f"source: {model.gains_source_ or 'unknown'}"
        )


def usual_gain_share(model: RobotEstimator) -> float:
    """Return the relative standard deviation of the drive gains of a model, by their source."""
    if model.effort_kind_ == "torque":
        return 0.0
    return CALIBRATED_SHARE if calibrated(model.gains_source_) else GAIN_SHARE
