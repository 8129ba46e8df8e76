"""The static paper's protocol, computed: eq. 20, split by sample, networks on what it leaves.

Everything here departs from an honest evaluation on purpose, to be compared with the paper: the
measured current is among the inputs, and each pose is on both sides of the split.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.data.dataset import Dataset
from hil.data.splits import paper_sample_split, split
from hil.evaluate.metrics import rmse
from hil.identify.dwell_rows import scatter
from hil.identify.linear_methods import Method, Weights
from hil.identify.static_linear import StaticLinear
from hil.study.separation_data import Recording, dwell_means, one_per_pose, rows_in
from hil.study.separation_networks import (
    Networks,
    NetworkSettings,
    Target,
    gathered,
    network_tasks,
)
from hil.study.separation_tasks import Task
from hil.typing import FloatArray, IntArray

METHODS: tuple[Method, ...] = ("ls", "ridge", "lasso", "elastic-net", "wls")
INPUTS = slice(1, 5)
"""q2…q5, what the paper's networks see."""

SHARES = (0.75, 0.20, 0.05)
TIMED = 3
"""Fits of which the fastest is reported: the first one also loads libraries."""

Layout = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """Rows to train, test and validate on.

    Attributes:
        training: The training rows as a dataset.
        train, test, validation: (·,) row numbers.
    """

    training: Dataset
    train: IntArray
    test: IntArray
    validation: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """One of the five methods on eq. 20.

    Attributes:
        model: Fitted to the training rows.
        estimate: (N, n) current of every row.
        seconds: The fit took.
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
        outputs: (S, n) of the networks, per dwell.
    """

    partition: Partition
    residual: FloatArray
    outputs: FloatArray

    def error(self, dwell: IntArray) -> FloatArray:
        """(N, n) of the whole model, for rows of these dwells (N,)."""
        left: FloatArray = self.residual - self.outputs[dwell]
        return left


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

    def separated(self, layout: Layout | None = None) -> Separated:
        """WLS and the networks of a layout."""
        outputs = self.networks[layout or self.layout].outputs
        return Separated(self.partition, self.data["effort"] - self.wls.estimate, outputs)

    def means_rmse(self, rows: IntArray) -> FloatArray:
        """(n,) RMSE of the errors, averaged over what `rows` hold of each dwell."""
        error, dwell = self.separated().error(self.dwell)[rows], self.dwell[rows]
        _, number = np.unique(dwell, return_inverse=True)
        sums = np.zeros((int(number.max(initial=-1)) + 1, error.shape[1]))
        np.add.at(sums, number, error)
        means = sums / np.bincount(number)[:, None]
        return rmse(means, np.zeros_like(means))

    def residual_noise(self) -> FloatArray:
        """(n,) scatter of WLS's residual within dwells: no function of the pose gets below it."""
        left = self.separated().residual
        dwells = self.data.with_columns(effort=left)
        freedom = np.diff(self.data.offsets) - 1.0
        return np.asarray(np.sqrt(freedom @ scatter(dwells) / max(float(freedom.sum()), 1.0)))


class PaperProtocol:
    """Prepares the fits and trainings of the protocol, and gathers what they find.

    Args:
        recording: The run.
        layouts: Of networks to compare.
        layout: The one shown in detail.
        settings: Of the trainings.
        alpha: Weight of the penalties.
        weights: Of WLS.

    Raises:
        FitError: The data do not allow it, or the robot is not one eq. 15 is for.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        layouts: Sequence[Layout],
        layout: Layout,
        settings: NetworkSettings,
        alpha: float,
        weights: Weights,
    ) -> None:
        self._robot, self._settings = recording.robot, settings
        self._alpha, self._weights = alpha, weights
        self._layout, self._layouts = layout, tuple(dict.fromkeys((*layouts, layout)))
        self._data = data = one_per_pose(recording.dwells, settings.seed)
        self._dwell = data.series_index()
        self._inputs = dwell_means(data, data["q"])[:, INPUTS]
        self._by_sample = by_sample(data, settings.seed)
        self._by_pose = by_pose(data, settings.seed)
        self._linear = {method: self._fitted(method, self._by_sample) for method in METHODS}
        held_out = self._fitted("wls", self._by_pose)
        self._residual = data["effort"] - self._linear["wls"].estimate
        self._targets = (
            (self._by_pose, data["effort"] - held_out.estimate),
            (self._by_sample, self._dealt(self._residual)),
            (self._by_pose, self._dealt(self._residual)),
        )

    def tasks(self) -> list[Task]:
        """Every training, in the order `gather` wants their results."""
        wanted = [(layout, self._by_sample, self._residual) for layout in self._layouts]
        wanted += [(self._layout, *target) for target in self._targets]
        joints = range(self._data.n_joints)
        return [
            task
            for layout, partition, residual in wanted
            for task in network_tasks(
                self._target(partition, residual), layout, self._settings, joints
            )
        ]

    def gather(self, results: Sequence[tuple[FloatArray, float]]) -> PaperRun:
        """The results of `tasks`, put together."""
        n = self._data.n_joints
        each = [results[start : start + n] for start in range(0, len(results), n)]
        networks = {
            layout: gathered(found, self._settings.mlp(layout).n_weights)
            for layout, found in zip(self._layouts, each, strict=False)
        }
        others = [
            Separated(partition, residual, gathered(found, 0).outputs)
            for (partition, residual), found in zip(
                self._targets, each[len(self._layouts) :], strict=True
            )
        ]
        return PaperRun(
            self._data, self._dwell, self._by_sample, self._linear, networks, self._layout,
            others[0], (others[1], others[2]),
        )  # fmt: skip

    def _fitted(self, method: Method, partition: Partition) -> LinearFit:
        best = np.inf
        for _ in range(TIMED):
            model = StaticLinear(
                method=method, form="paper", rows="samples", current_term=True,
                alpha=self._alpha, weights=self._weights,
            )  # fmt: skip
            begin = time.perf_counter()
            model.fit(partition.training, self._robot)
            best = min(best, time.perf_counter() - begin)
        return LinearFit(model, model.predict(self._data).effort, best)

    def _target(self, partition: Partition, residual: FloatArray) -> Target:
        rows = partition.train
        return Target(self._inputs, residual[rows], self._dwell[rows])

    def _dealt(self, residual: FloatArray) -> FloatArray:
        """What is left of each dwell goes to another one, drawn; its samples scatter as before."""
        means = dwell_means(self._data, residual)
        order = np.random.default_rng([self._settings.seed, 2]).permutation(len(means))
        moved: FloatArray = residual + (means[order] - means)[self._dwell]
        return moved


def by_sample(data: Dataset, seed: int) -> Partition:
    """75/20/5 % of the samples, as the paper: ten samples of a pose land on all sides."""
    training, test, validation = paper_sample_split(data, SHARES, seed)
    return Partition(training, rows_in(training), rows_in(test), rows_in(validation))


def by_pose(data: Dataset, seed: int) -> Partition:
    """The same shares of whole poses."""
    outer = split(data, "pose", SHARES[1], seed)
    inner = split(outer.train, "pose", SHARES[2] / (1 - SHARES[1]), seed)
    parts = inner.train, outer.test, inner.test
    return Partition(inner.train, *(rows_in(part) for part in parts))
