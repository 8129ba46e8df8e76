"""What judging a model on recordings comes to: its errors, and what to know before believing them.

A model is not judged on what it was fitted to. Where that cannot be refused, because every sample
is new and yet nothing else is, a note says so.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import DataError, card, json_document, write_whole
from hil.data import SAME_SHARE, Dataset, revisited
from hil.estimators import RobotEstimator
from hil.evaluation.evaluation import Evaluation
from hil.evaluation.validation_load import UnderLoad
from hil.importers import serial_of

EVALUATION_FILE = "evaluation.json"

SAME_MOTION_SHARE = 0.5
"""Share of a held-out series' poses in the training data above which it is no new motion."""


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
        told = {"notes": list(self.notes), "under_load": self._under_load()}
        return named | {key: total[key] for key in keys} | told

    def to_keep(self) -> dict[str, Any]:
        """An entry of a model's `evaluation.json`."""
        told = {"notes": list(self.notes), "under_load": self._under_load()}
        return {"source": self.source, **self.errors.to_dict(), **told}

    def _under_load(self) -> dict[str, Any] | None:
        return None if self.under_load is None else self.under_load.to_dict()


def serial_notes(serial: str, source: Path) -> Iterator[str]:
    """A note when a source is of another individual than the training data."""
    other = serial_of(source)
    if serial and other and serial != other:
        yield f"recorded on another robot (serial {other}) than the training data ({serial})"


def motion_notes(train: Dataset, test: Dataset) -> Iterator[str]:
    """A note when the test data repeat motions: no sample is shared, yet nothing is new."""
    shares = revisited(train, test)
    known = [share for share in shares.values() if share > SAME_MOTION_SHARE]
    if known:
        yield (
            f"{len(known)} of {len(shares)} series lead through poses of the training data again "
            "(the same program?): errors on them say little about new motions"
        )


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
