"""Two models on the same data: which one errs less, and is that more than chance?

Errors of neighbouring samples are alike, so data count by blocks of time. Each block says by how
much the challenger's squared error differs from the champion's, every joint as a share of the
champion's own; Student's t of the blocks says what the difference may be with 95 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from hil.data.dataset import Dataset
from hil.data.load import load_source
from hil.errors import RegistryError
from hil.evaluate.evaluation import filtered_effort
from hil.fitting import usable_part
from hil.identify.base import RobotEstimator
from hil.typing import FloatArray
from hil.validation import require_unseen

BLOCK_S = 5.0
"""Of time that counts as one observation; friction and load keep errors alike for about as long."""

SURE = 0.95
FEWEST_BLOCKS = 6

WORST_JOINT = 1.05
"""A single joint may not err more than so many times what it did, however good the others are."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two models on the same rows.

    Attributes:
        unit: Of the errors.
        joint_names: Length n.
        sources: What they were compared on.
        samples: Rows.
        blocks: Of time.
        champion, challenger: (n,) RMSE against the filtered effort.
        difference: Mean over joints and blocks of the squared error's difference, as a share of the
            champion's squared error; negative where the challenger errs less.
        interval: Of that, with 95 %.
    """

    unit: str
    joint_names: tuple[str, ...]
    sources: tuple[str, ...]
    samples: int
    blocks: int
    champion: FloatArray
    challenger: FloatArray
    difference: float
    interval: tuple[float, float]

    @property
    def better(self) -> bool:
        """The challenger errs less for sure, and in no joint clearly more."""
        return self.interval[1] < 0.0 and bool(np.all(self.ratio <= WORST_JOINT))

    @property
    def worse(self) -> bool:
        """The challenger errs more, by whatever: such a one is never promoted."""
        return self.difference > 0.0 or bool(np.any(self.ratio > WORST_JOINT))

    @property
    def ratio(self) -> FloatArray:
        """(n,) of the challenger's RMSE to the champion's."""
        least = np.finfo(np.float64).tiny
        found: FloatArray = self.challenger / np.maximum(self.champion, least)
        return found

    @property
    def words(self) -> str:
        """One sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * self.difference:+.1f} % squared error ({low:+.1f} … {high:+.1f})"
        if self.better:
            return f"the challenger errs less: {spread}"
        if bool(np.any(self.ratio > WORST_JOINT)) and self.difference <= 0.0:
            joint = self.joint_names[int(np.argmax(self.ratio))]
            return f"{joint} errs {np.max(self.ratio):.2f} times as much, though in all {spread}"
        return f"the challenger errs {'more' if self.worse else 'no less that is sure'}: {spread}"

    def to_dict(self) -> dict[str, Any]:
        """JSON form; the evidence of a promotion."""
        return {
            "unit": self.unit,
            "joint_names": list(self.joint_names),
            "sources": list(self.sources),
            "samples": self.samples,
            "blocks": self.blocks,
            "champion_rmse": self.champion.tolist(),
            "challenger_rmse": self.challenger.tolist(),
            "difference": self.difference,
            "interval_95": list(self.interval),
            "better": self.better,
            "worse": self.worse,
            "words": self.words,
        }


def compare_sources(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> Comparison:
    """Compare two models on recordings neither was fitted to.

    Raises:
        DataError: A source cannot be read, or one of them was fitted to it.
        FitError: It holds nothing they work on.
        RegistryError: They are of different joints or units, or the data are too short.
    """
    parts = unseen_parts((champion, challenger), sources)
    return compare(champion, challenger, parts, tuple(str(source) for source in sources))


def unseen_parts(models: Sequence[RobotEstimator], sources: Sequence[Path]) -> list[Dataset]:
    """What the models work on of each source.

    Raises:
        DataError: A source cannot be read, or one of the models was fitted to it.
        FitError: It holds nothing the first of them works on.
    """
    parts = []
    for source in sources:
        data = usable_part(load_source(source), models[0])
        for model in models:
            require_unseen(model, source, data)
        parts.append(data)
    return parts


def compare(
    champion: RobotEstimator,
    challenger: RobotEstimator,
    parts: Sequence[Dataset],
    sources: tuple[str, ...] = (),
) -> Comparison:
    """The same on datasets; that nothing of them was learned is the caller's affair.

    Raises:
        DataError: They are not of the models' robot.
        RegistryError: As `compare_sources`.
    """
    _require_alike(champion, challenger)
    errors = [_squared(champion, challenger, data) for data in parts]
    blocks = [
        block for data, pair in zip(parts, errors, strict=True) for block in _blocks(data, pair)
    ]
    if len(blocks) < FEWEST_BLOCKS:
        raise RegistryError(
            f"there are only {len(blocks)} blocks of {BLOCK_S:.0f} s to compare on",
            hint=f"give recordings of at least {FEWEST_BLOCKS * BLOCK_S:.0f} s",
        )
    both = np.concatenate([np.stack(pair, axis=1) for pair in errors])
    old, new = np.sqrt(np.nanmean(both, axis=0))
    means = np.array(blocks)
    share = np.mean(
        (means[:, 1] - means[:, 0]) / np.maximum(old, np.finfo(float).tiny) ** 2, axis=1
    )
    centre = float(np.mean(share))
    half = float(student.ppf(0.5 + SURE / 2, len(share) - 1) * np.std(share, ddof=1))
    half /= float(np.sqrt(len(share)))
    data = parts[0]
    return Comparison(
        data.effort_unit, data.joint_names, sources, int(np.sum(np.isfinite(both[:, 0, 0]))),
        len(share), old, new, centre, (centre - half, centre + half),
    )  # fmt: skip


def _squared(
    champion: RobotEstimator, challenger: RobotEstimator, data: Dataset
) -> tuple[FloatArray, FloatArray]:
    """(N, n) squared errors of both, NaN where one of them says nothing."""
    measured = filtered_effort(data)
    predictions = [model.predict(data) for model in (champion, challenger)]
    known = predictions[0].valid & predictions[1].valid & np.isfinite(measured)
    old, new = ((measured - one.effort) ** 2 for one in predictions)
    return np.where(known, old, np.nan), np.where(known, new, np.nan)


def _blocks(data: Dataset, pair: tuple[FloatArray, FloatArray]) -> Iterator[FloatArray]:
    """(2, n) mean squared errors of both models, block by block; series are never joined."""
    for _, rows in data.slices():
        if rows.stop <= rows.start:
            continue
        t = data["t"][rows]
        count = max(1, round(float(t[-1] - t[0]) / BLOCK_S))
        for piece in np.array_split(np.arange(rows.start, rows.stop), count):
            found = np.stack([one[piece] for one in pair])
            if np.all(np.any(np.isfinite(found), axis=1)):
                yield np.nanmean(found, axis=1)


def _require_alike(champion: RobotEstimator, challenger: RobotEstimator) -> None:
    for what in ("joint_names_", "effort_kind_"):
        old, new = getattr(champion, what), getattr(challenger, what)
        if old != new:
            raise RegistryError(
                f"the champion's {what.strip('_').replace('_', ' ')} are {old}, "
                f"the challenger's {new}",
                hint="models of different robots belong under different names",
            )
