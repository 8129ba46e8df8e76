"""What is found under the static paper's protocol, and the errors of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset, rmse
from hil.estimators import Method, StaticLinear
from hil.studies.separation_data import sample_noise
from hil.studies.separation_networks import Networks
from hil.studies.separation_split import Partition

Layout = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """One of the five methods on eq. 20.

    Attributes:
        model: Fitted to the training rows.
        estimate: (N, n) current of every row.
        seconds: The fit took, of one core.
    """

    model: StaticLinear
    estimate: FloatArray
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Separated:
    """Gravity by WLS and friction by networks, under one split and for one target.

    Attributes:
        partition: Which rows were for what.
        residual: (N, n) what WLS leaves, or what stands in its place.
        friction: (N, n) of the networks.
    """

    partition: Partition
    residual: FloatArray
    friction: FloatArray

    def rmse(self, rows: IntArray) -> FloatArray:
        """(n,) of the whole model at some rows."""
        return rmse(self.residual[rows], self.friction[rows])

    @property
    def train(self) -> FloatArray:
        """(n,) RMSE at the training rows."""
        return self.rmse(self.partition.train)

    @property
    def test(self) -> FloatArray:
        """(n,) RMSE at the test rows."""
        return self.rmse(self.partition.test)


@dataclass(frozen=True, slots=True, eq=False)
class PaperRun:
    """Everything found under the paper's protocol.

    Attributes:
        data: One dwell per pose.
        dwell: (N,) dwell of each row.
        partition: By sample.
        linear: The five methods, by name.
        networks: By layout.
        layout: The one that figures and Table 4 show.
        poses_held_out: The same with whole poses held out.
        dealt: Friction dealt out among the poses, split by sample and by pose.
    """

    data: Dataset
    dwell: IntArray
    partition: Partition
    linear: Mapping[Method, LinearFit]
    networks: Mapping[Layout, Networks]
    layout: Layout
    poses_held_out: Separated
    dealt: tuple[Separated, Separated]

    @property
    def wls(self) -> LinearFit:
        """What the networks build on."""
        return self.linear["wls"]

    @property
    def residual(self) -> FloatArray:
        """(N, n) what WLS leaves."""
        return np.asarray(self.data["effort"] - self.wls.estimate)

    def separated(self, layout: Layout | None = None) -> Separated:
        """WLS and the networks of a layout."""
        friction = self.networks[layout or self.layout].outputs[self.dwell]
        return Separated(self.partition, self.residual, friction)

    def linear_rmse(self, method: Method, rows: IntArray) -> FloatArray:
        """(n,) of one of the five methods."""
        return rmse(self.data["effort"][rows], self.linear[method].estimate[rows])

    def means_rmse(self, rows: IntArray | None = None) -> FloatArray:
        """(n,) RMSE of the errors averaged over what `rows` (None: all) hold of each dwell."""
        one = self.separated()
        chosen = np.arange(len(self.dwell)) if rows is None else rows
        error = (one.residual - one.friction)[chosen]
        _, number = np.unique(self.dwell[chosen], return_inverse=True)
        sums = np.zeros((int(number.max(initial=-1)) + 1, error.shape[1]))
        np.add.at(sums, number, error)
        means = sums / np.bincount(number)[:, None]
        return rmse(means, np.zeros_like(means))

    def residual_noise(self) -> FloatArray:
        """(n,) scatter of WLS's residual within dwells: no function of the pose gets below it."""
        return sample_noise(self.data.with_columns(effort=self.residual))

    def beyond_noise(self) -> FloatArray:
        """(n,) √(test² − noise²): about the error against what a dwell is on average."""
        square = self.separated().test ** 2 - self.residual_noise() ** 2
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def explained(self, joint: int) -> float:
        """Share of the variance of a joint's test currents that WLS on eq. 20 takes up."""
        rows = self.partition.test
        variance = float(np.var(self.data["effort"][rows, joint]))
        left = float(self.linear_rmse("wls", rows)[joint]) ** 2
        return 1.0 - left / variance if variance > 0 else float("nan")
