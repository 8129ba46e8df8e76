"""Validation of a model on recordings it has not seen: errors, notes, and its load checked.

A model is not judged on what it was fitted to (`require_unseen`). Where that cannot be refused,
because every sample is new and yet nothing else is, a note says so.

A recording with a load that the model was not fitted with is judged with that load, too
(`under_load`): as declared, unaware of it, and as the recording itself tells. One recording has no
other motion to identify its load from, so each half of every series is predicted with the load that
the other half tells.
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
    """A model's errors on one source.

    Attributes:
        source: Run directory or file.
        errors: The evaluation.
        notes: What to know before believing it, for people.
        under_load: How it does under the load of the source; None where that is no new one.
    """

    source: str
    errors: Evaluation
    notes: tuple[str, ...] = ()
    under_load: UnderLoad | None = None

    def __repr__(self) -> str:
        return f"<Validation on {self.source}: {self.errors!r}>"

    def _repr_html_(self) -> str:
        """Itself in a notebook."""
        return card("Validation on", self.source, {}, notes=self.notes) + self.errors._repr_html_()

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil fit --json` and `hil evaluate --json`."""
        total = self.errors.total.to_dict()
        keys = ("rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered", "noise_floor", "nrmse")
        named = {"source": self.source, "unit": self.errors.unit}
        return named | {key: total[key] for key in keys} | self._beside()

    def to_keep(self) -> dict[str, Any]:
        """An entry of a model's `evaluation.json`."""
        return {"source": self.source, **self.errors.to_dict(), **self._beside()}

    def _beside(self) -> dict[str, Any]:
        under = None if self.under_load is None else self.under_load.to_dict()
        return {"notes": list(self.notes), "under_load": under}


def keep(path: Path, judged: Sequence[Validation]) -> None:
    """Add evaluations to a model's file; what it says about other sources stays.

    Raises:
        DataError: The file is there and is no evaluation.
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
            f"{path} is no evaluation: {error}", hint="move it away, then fit again"
        ) from error
    return document


def seen_share(model: RobotEstimator, data: Dataset) -> float:
    """Share of a dataset's samples that are among those a model was fitted to."""
    return model.training_.rows.share_known(data) if model.training_ else 0.0


def require_unseen(model: RobotEstimator, source: Path, data: Dataset) -> None:
    """Refuse to judge a model on its own training data.

    Raises:
        DataError: They are among the data; older model files cannot tell.
    """
    share = seen_share(model, data)
    if model.training_ and share > SAME_SHARE:
        raise DataError(
            f"{source}: about {100 * share:.0f} % of its samples are among those the model was "
            f"fitted to ({', '.join(model.training_.sources) or 'its training data'})",
            hint="judge the model on a recording it has not seen",
        )


def serial_notes(serial: str, source: Path) -> Iterator[str]:
    """A note when a source is of another individual than the training data."""
    other = serial_of(source)
    if serial and other and serial != other:
        yield f"recorded on another robot (serial {other}) than the training data ({serial})"


SAME_MOTION_SHARE = 0.5
"""Share of a held-out series' poses in the training data above which it is no new motion."""


def motion_notes(train: Dataset, test: Dataset) -> Iterator[str]:
    """A note when the test data repeat motions: no sample is shared, yet nothing is new."""
    shares = revisited(train, test)
    known = [share for share in shares.values() if share > SAME_MOTION_SHARE]
    if known:
        yield (
            f"{len(known)} of {len(shares)} series lead through poses of the training data again "
            "(the same program?): errors on them say little about new motions"
        )


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoad:
    """What a model is worth on a recording with a load that it was not fitted with, or a wrong one.

    Attributes:
        declared: The load, as the recording declares it.
        new: Whether the model was fitted without it; None where nobody knows.
        rmse: (n,) against the filtered effort, where nobody tells the model of the load
            (`unaware`), as `declared`, and as the other half of the recording tells (`identified`;
            not there where it does not).
        estimate: The load by all of the recording; None where it does not tell.
        check: The declaration against it.
        unexplained: What contradicts it unless the drive gains are wrong; nothing where it agrees
            whatever they are.
        failed: Why there is none.
    """

    declared: Payload
    new: bool | None
    rmse: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    check: Declaration | None = None
    unexplained: tuple[str, ...] = ()
    failed: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Part of the contract of `hil fit --json` and `hil evaluate --json`."""
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
    """Judge a model under the load of a recording.

    Args:
        model: Of the arm.
        data: The recording, as measured.
        known: Loads it was fitted with; None where nobody knows.

    Returns:
        None where there is nothing to tell: the arm rests, the loads are several, or it is a load
        that the model knows (nothing, where nobody knows) and the recording does not contradict it.
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
    """(n,) RMSE over what the model vouches for; NaN for a joint of which it does so nowhere."""
    error = filtered_effort(data) - effort
    known = np.isfinite(error)
    count = np.count_nonzero(known, axis=0)
    total = np.sum(np.where(known, error, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """(N, n) effort; NaN where the model does not vouch for it."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _by_halves(model: RobotEstimator, data: Dataset) -> FloatArray:
    """(N, n) effort of every half with the load that the other tells; friction is the model's."""
    by_first, by_second = (
        _effort(model, data, half.estimate.payload) for half in payload_halves(model, data)
    )
    first, _ = halves(data)
    return np.where(first[:, None], by_second, by_first)
