"""What came of one protocol of a study of inverse dynamics, over its seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.data import motion_rates
from hil.studies.inverse_cases import Case
from hil.studies.inverse_methods import LATENCY_S, PREVIOUS_S, ROWS
from hil.studies.inverse_noise import Held, persistence_of, white_noise_left
from hil.studies.inverse_score import Judged, cloud_rows, shown_rows


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a case has to show beside any model, in N·m.

    Attributes:
        t, measured: (rows,), (rows, n) of the first judged trajectory, filtered.
        speeds, cloud: (cloud, n) velocity [rad/s] and filtered torque over all judged rows.
        removed: (n,) RMS of what the filter takes out of the measured torque.
        noise: (n,) RMS of the noise that it leaves, if the noise is white.
        persistence: By latency [s], of repeating the newest torque that is so old at least.
        rate_hz: Samples per second, as recorded: the median over the judged trajectories.
    """

    t: FloatArray
    measured: FloatArray
    speeds: FloatArray
    cloud: FloatArray
    removed: FloatArray
    noise: FloatArray
    persistence: Mapping[float, Held]
    rate_hz: float

    @staticmethod
    def of(case: Case) -> Seen:
        """Of one case."""
        data, rows, cloud = case.judge, shown_rows(case), cloud_rows(case)
        torque = data["effort_f"] * case.scale
        removed = np.sqrt(np.mean((data["effort"] - data["effort_f"])[case.rows] ** 2, axis=0))
        return Seen(
            data["t"][rows] - data["t"][0],
            torque[rows],
            data["qd_f"][cloud],
            torque[cloud],
            removed * case.scale,
            white_noise_left(removed * case.scale, case),
            {latency: persistence_of(case, latency) for latency in (PREVIOUS_S, LATENCY_S)},
            # Never refused: samples may be missing in one trajectory, and this is only shown.
            float(np.median([rate for rate, _ in motion_rates(data)])),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One protocol: the same cases for every method.

    Attributes:
        protocol: Its name.
        scores: By key of the row, one per seed; rows that failed in any are left out.
        failed: By key of the row, why.
        seen: One per seed.
        loads: Name of every load but the first by its number.
    """

    protocol: str
    scores: Mapping[str, Sequence[Judged]]
    failed: Mapping[str, str]
    seen: Sequence[Seen]
    loads: Mapping[int, str]

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.seen[0].noise)

    def words(self, key: str) -> str:
        """What a row is called, with the latency that it has at the rate of these data."""
        return ROWS[key].words_at(self.seen[0].rate_hz)

    def mean(self, key: str, measure: str) -> FloatArray:
        """(n,) mean over the seeds."""
        return np.asarray(np.mean([getattr(s, measure) for s in self.scores[key]], axis=0))

    def by_seed(self, key: str, measure: str = "filtered") -> FloatArray:
        """(seeds,) mean over the joints."""
        return np.array([float(np.mean(getattr(s, measure))) for s in self.scores[key]])

    def spread(self, key: str, measure: str) -> float:
        """Standard deviation over the seeds of the mean over the joints; NaN with one seed."""
        means = self.by_seed(key, measure)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str = "filtered") -> float:
        """Mean over joints and seeds."""
        return float(np.mean(self.by_seed(key, measure)))

    def beside(self, what: str) -> FloatArray:
        """(seeds, n) of an attribute of `Seen` that is (n,)."""
        return np.stack([getattr(seen, what) for seen in self.seen])

    def persistence(self, latency_s: float) -> Held:
        """Repeated torque, in the mean over the seeds."""
        every = [seen.persistence[latency_s] for seen in self.seen]
        error = np.mean([one.error for one in every], axis=0)
        return Held(float(np.mean([one.age_s for one in every])), error)


def gathered(
    protocol: str,
    results: Iterable[tuple[Sequence[str], Sequence[Mapping[str, Judged]]]],
    seen: Sequence[Seen],
    loads: Mapping[int, str],
) -> Found:
    """All families of one protocol.

    Args:
        protocol: Its name.
        results: Per family its rows, and what came of them, once per seed.
        seen: One per seed.
        loads: Names of the loads.
    """
    scores: dict[str, list[Judged]] = {}
    failed: dict[str, str] = {}
    for keys, by_seed in results:
        for key in keys:
            found = [one[key] for one in by_seed]
            reason = next((score.failed for score in found if score.failed), "")
            if reason:
                failed[key] = reason
            else:
                scores[key] = found
    return Found(protocol, scores, failed, seen, loads)
