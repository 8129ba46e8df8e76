"""What trained networks add to the physics, where they were kept."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.data import Dataset
from hil.estimators import with_prefix, without_prefix
from hil.networks.residual.fit import in_motion
from hil.networks.residual.motions import Motions
from hil.networks.residual.settings import ResidualSettings
from hil.networks.residual.stored import require_finite_arrays
from hil.networks.residual.trained import TrainedTcn

NETWORK = "network{}."
"""Arrays of the network with that number, from 1, begin with it."""

NUMBERED = re.compile(r"network(\d+)\.")

KEPT, LIMIT = "kept", "limit"


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The mean of the networks.

    Attributes:
        settings: Of every network.
        networks: At least one, even where no joint keeps it.
        kept: (n,) joints that are corrected.
        limit: (n,) largest correction, in effort units: the largest residual there was to learn.
            Loads and motions that no training has seen can make a network say anything.
    """

    settings: ResidualSettings
    networks: tuple[TrainedTcn, ...]
    kept: BoolArray
    limit: FloatArray

    def predict(self, data: Dataset, base: FloatArray) -> FloatArray:
        """(N, n) for prepared data, 0 at rest.

        Raises:
            DataError: The torque to be heard is missing, or samples come at another rate.
        """
        moving = in_motion(data)
        if not np.any(moving) or not np.any(self.kept):
            return np.zeros_like(base)
        motions = Motions.of(data, base, self.settings)
        mean = np.mean([network.predict(motions) for network in self.networks], axis=0)
        return np.where(moving[:, None], self.bounded(mean), 0.0)

    def bounded(self, mean: FloatArray) -> FloatArray:
        """(…, n) the networks' mean within its limits, 0 for joints without network."""
        return np.where(self.kept, np.clip(mean, -self.limit, self.limit), 0.0)

    def to_arrays(self) -> dict[str, FloatArray]:
        """For a model file; the settings go beside them."""
        arrays = {KEPT: self.kept.astype(np.float64), LIMIT: self.limit}
        for number, network in enumerate(self.networks, start=1):
            arrays |= with_prefix(NETWORK.format(number), network.to_arrays())
        return arrays

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: dict[str, Any], networks: int
    ) -> Correction:
        """Inverse of `to_arrays`.

        Raises:
            KeyError, ValueError, DataError: Something is missing or garbled.
        """
        stored = {int(named[1]) for name in arrays if (named := NUMBERED.match(name))}
        if not stored or networks != len(stored) or networks != max(stored) or min(stored) < 1:
            raise ValueError(f"networks: {networks} where those stored are {sorted(stored)}")
        found = [
            _network(without_prefix(NETWORK.format(k + 1), arrays), settings)
            for k in range(networks)
        ]
        kept, limit = (np.asarray(arrays[name], dtype=np.float64) for name in (KEPT, LIMIT))
        if not np.all(np.isin(kept, (0.0, 1.0))) or not np.all(np.isfinite(limit) & (limit >= 0)):
            raise ValueError(f"{KEPT}, {LIMIT}: {kept.tolist()!s:.60}, {limit.tolist()!s:.60}")
        if not all(network.n == len(kept) == len(limit) for network in found):
            raise ValueError(f"{KEPT}: {len(kept)} joints")
        given = ResidualSettings.given(settings)
        return Correction(given, tuple(found), kept == 1.0, limit)


def _network(arrays: dict[str, FloatArray], settings: dict[str, Any]) -> TrainedTcn:
    # Without slow and fast parts there is no frequency between them.
    require_finite_arrays({name: a for name, a in arrays.items() if name != "f_cut_hz"})
    return TrainedTcn.from_arrays(arrays, settings)
