"""Validation of a model on new recordings: errors, notes, and a check of the payload.

A model is never evaluated on its training data (`require_unseen`). If all samples are new but the
motion or the individual robot gives reason for doubt, a note reports the doubt.

A recording with a payload that was not in the training data is also evaluated with this payload
(`under_load`): as declared, without payload, and as identified from the recording. A single
recording contains no second motion from which its payload could be identified. The effort of each
half of every series is therefore predicted with the payload identified from the other half.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray, HilError, card, json_document, write_whole
from hil.data import SAME_SHARE, Dataset, revisited
from hil.estimators import (
    Declaration,
    PayloadEstimate,
    RobotEstimator,
    check_declarations,
    estimate_payload,
    halves,
    payload_halves,
    with_identified,
)
from hil.evaluation.evaluation import Evaluation, filtered_effort
from hil.importers import serial_of

EVALUATION_FILE = "evaluation.json"


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Prediction errors of a model on one source.

    Attributes:
        source: Path of the run directory or file.
        errors: Evaluation of the model on the source.
        notes: List of notes for the user that limit the significance of the errors.
        under_load: Evaluation with the payload of the source; None if the payload was in the
            training data.
    """

    source: str
    errors: Evaluation
    notes: tuple[str, ...] = ()
    under_load: UnderLoad | None = None

    def __repr__(self) -> str:
        return f"<Validation on {self.source}: {self.errors!r}>"

    def _repr_html_(self) -> str:
        """Return the validation as an HTML summary for a notebook."""
        return card("Validation on", self.source, {}, notes=self.notes) + self.errors._repr_html_()

    def to_dict(self) -> dict[str, Any]:
        """Return the validation in the format of `hil fit --json` and `hil evaluate --json`."""
        total = self.errors.total.to_dict()
        keys = ("rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered", "noise_floor", "nrmse")
        named = {"source": self.source, "unit": self.errors.unit}
        return named | {key: total[key] for key in keys} | self._beside()

    def to_keep(self) -> dict[str, Any]:
        """Return the validation as an entry for the `evaluation.json` of a model."""
        return {"source": self.source, **self.errors.to_dict(), **self._beside()}

    def _beside(self) -> dict[str, Any]:
        under = None if self.under_load is None else self.under_load.to_dict()
        return {"notes": list(self.notes), "under_load": under}


def keep(path: Path, judged: Sequence[Validation]) -> None:
    """Add validations to the evaluation file of a model; entries of other sources are kept.

    Raises:
        DataError: The evaluation file exists but is not valid.
    """
    if not judged:
        return
    document = _evaluations(path)
    fresh = [one.to_keep() for one in judged]
    again = {one.source for one in judged}
    kept = [entry for entry in document.get("validation", ()) if entry["source"] not in again]
    content = json_document(document | {"validation": [*kept, *fresh]})
    if not path.exists() or path.read_bytes() != content:
        write_whole(path, content)


def _evaluations(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        document: dict[str, Any] = json.loads(path.read_bytes())
        _ = [entry["source"] for entry in document.get("validation", ())]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path} is not a valid evaluation: {error}", hint="move it away, then fit again"
        ) from error
    return document


def seen_share(model: RobotEstimator, data: Dataset) -> float:
    """Return the share of the samples of a dataset that are in the training data of a model."""
    return model.training_.rows.share_known(data) if model.training_ else 0.0


def require_unseen(model: RobotEstimator, source: Path, data: Dataset) -> None:
    """Raise if a recording contains training data of the model.

    Raises:
        DataError: The recording contains training samples of the model. A model without a summary
            of its training data cannot be checked and is therefore accepted.
    """
    share = seen_share(model, data)
    if model.training_ and share > SAME_SHARE:
        raise DataError(
            f"{source}: about {100 * share:.0f} % of its samples are training data of the model "
            f"({', '.join(model.training_.sources) or 'sources unknown'})",
            hint="evaluate the model on a recording that its fit did not use",
        )


def serial_notes(serial: str, source: Path) -> Iterator[str]:
    """Yield a note if source and training data are of different individual robots."""
    other = serial_of(source)
    if serial and other and serial != other:
        yield f"recorded on another robot (serial {other}) than the training data ({serial})"


SAME_MOTION_SHARE = 0.5
"""Share of a held-out series' poses in the training data above which its motion is not new."""


def motion_notes(train: Dataset, test: Dataset) -> Iterator[str]:
    """Yield a note if the test data repeat motions of the training data with new samples."""
    shares = revisited(train, test)
    known = [share for share in shares.values() if share > SAME_MOTION_SHARE]
    if known:
        yield (
            f"{len(known)} of {len(shares)} series pass through poses of the training data (the "
            "same program?), so their errors say little about new motions"
        )


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoad:
    """Evaluation of a model on a recording with a new or wrongly declared payload.

    Attributes:
        declared: Payload as declared in the recording.
        new: Whether the payload was absent in the training data; None if the training payloads are
            unknown.
        rmse: (n,) errors relative to the filtered effort, for three payloads: none (`unaware`), the
            declared payload (`declared`), and the payload identified from the other half of the
            recording (`identified`, absent if the identification failed).
        estimate: Payload identified from the whole recording; None if the identification failed.
        check: Check of the declared payload against the identified payload.
        unexplained: Contradictions to the declaration that drive-gain errors could explain; empty
            if there are none.
        failed: Reason why the identification failed; empty if it succeeded.
    """

    declared: Payload
    new: bool | None
    rmse: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    check: Declaration | None = None
    unexplained: tuple[str, ...] = ()
    failed: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the evaluation under the payload, in the format of `hil evaluate --json`."""
        found, check = self.estimate, self.check
        return {
            "declared": {"mass_kg": self.declared.mass, "com_m": list(self.declared.com)},
            "new": self.new,
            "rmse": {
                told: [value if math.isfinite(value) else None for value in error.tolist()]
                for told, error in self.rmse.items()
            },
            "identified": None if found is None else found.to_dict()["payload"],
            "mass_std_kg": None if found is None else float(found.std_error[0]),
            "agrees": None if check is None else check.agrees,
            "contradictions": [] if check is None else [one.text for one in check.findings],
            "unless_gains_are_wrong": list(self.unexplained),
            "mass_limit_kg": None if check is None else float(check.limit[0]),
            "mount_observable": None if check is None else check.mount_observable,
            "failed": self.failed,
        }


def under_load(
    model: RobotEstimator, data: Dataset, known: Collection[Payload] | None
) -> UnderLoad | None:
    """Return the evaluation of a model with the payload of a recording.

    Args:
        model: Fitted model of the arm.
        data: Recording, unfiltered.
        known: Payloads of the training data; None if unknown.

    Returns:
        Evaluation; None if the recording is not a pure motion or has several payloads. None is also
        returned for a payload of the training data if the recording does not contradict its
        declaration. If the payloads of the training data are unknown, only an empty payload counts
        as a payload of the training data.
    """
    loads = {condition.payload for condition in data.conditions}
    moving = all(condition.kind == "trajectory" for condition in data.conditions)
    if len(loads) != 1 or not moving:
        return None
    (declared,) = loads
    usual = declared.is_empty if known is None else declared in known
    new = None if known is None else not usual
    try:
        estimate = estimate_payload(model, data)
        (check,) = check_declarations([declared], [estimate])
        if usual and check.agrees:
            return None
        rmse = _errors(model, data, declared)
        rmse["identified"] = _error(data, _by_halves(model, data))
    except HilError as error:
        if usual:
            return None
        return UnderLoad(declared, new, _errors(model, data, declared), failed=error.message)
    sure = replace(estimate, by_gain=np.zeros_like(estimate.by_gain))
    (surely,) = check_declarations([declared], [sure])
    told = tuple(one.text for one in surely.findings) if check.agrees else ()
    return UnderLoad(declared, new, rmse, estimate, check, told)


def _errors(model: RobotEstimator, data: Dataset, declared: Payload) -> dict[str, FloatArray]:
    return {
        "unaware": _error(data, _effort(model, data, Payload())),
        "declared": _error(data, _effort(model, data, declared)),
    }


def _error(data: Dataset, effort: FloatArray) -> FloatArray:
    """Return (n,) the RMSE over valid predictions; NaN for a joint without valid predictions."""
    error = filtered_effort(data) - effort
    known = np.isfinite(error)
    count = np.count_nonzero(known, axis=0)
    total = np.sum(np.where(known, error, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """Return (N, n) the predicted effort; NaN if the prediction is not valid."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _by_halves(model: RobotEstimator, data: Dataset) -> FloatArray:
    """Return (N, n) the effort of each half, predicted with the payload of the other half.

    The friction is that of the model, without a correction.
    """
    by_first, by_second = (
        _effort(model, data, half.estimate.payload) for half in payload_halves(model, data)
    )
    first, _ = halves(data)
    return np.where(first[:, None], by_second, by_first)
