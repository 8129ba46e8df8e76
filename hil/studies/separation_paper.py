"""The static paper's protocol, computed: eq. 20, split by sample, networks on what it leaves.

Everything here departs from an honest evaluation on purpose, to be compared with the paper: the
measured current is among the inputs, and each pose is on both sides of the split. `PaperProtocol`
fits the five linear methods, lists the trainings of the networks as tasks, and gathers them into a
`PaperRun`, which knows the errors.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from hil.core import DataError, FitError, FloatArray, IntArray
from hil.data import Dataset, rmse
from hil.estimators import Method, StaticLinear, Weights
from hil.networks import ConstantInputWarning, Mlp, train
from hil.studies.separation_data import (
    Partition,
    Recording,
    by_pose,
    by_sample,
    dwell_means,
    one_per_pose,
    sample_noise,
)
from hil.studies.tasks import Task

METHODS: tuple[Method, ...] = ("ls", "ridge", "lasso", "elastic-net", "wls")

INPUTS = slice(1, 5)
"""q2…q5, what the paper's networks see."""

TIMED = 3
"""Fits of which the fastest is reported: the first one also loads libraries."""

Layout = tuple[int, ...]


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
        try:
            sample, pose = by_sample(data, settings.seed), by_pose(data, settings.seed)
        except DataError as error:
            raise FitError(error.message, hint=error.hint) from error
        self._partition = sample
        self._linear = {method: self._fitted(method, sample) for method in METHODS}
        self._residual = data["effort"] - self._linear["wls"].estimate
        held_out = data["effort"] - self._fitted("wls", pose).estimate
        dealt = self._dealt(self._residual)
        self._targets = ((pose, held_out), (sample, dealt), (pose, dealt))

    def tasks(self) -> list[Task]:
        """Every training, in the order `gather` wants their results."""
        wanted = [(layout, self._partition, self._residual) for layout in self._layouts]
        wanted += [(self._layout, *target) for target in self._targets]
        joints = range(self._data.n_joints)
        return [
            task
            for layout, partition, residual in wanted
            for task in network_tasks(
                self._target(partition, residual), layout, self._settings, joints
            )
        ]

    def gather(self, results: Sequence[NetworkResult]) -> PaperRun:
        """The results of `tasks`, put together."""
        n = self._data.n_joints
        each = [gathered(results[start : start + n]) for start in range(0, len(results), n)]
        networks = dict(zip(self._layouts, each, strict=False))
        poses, *dealt = (
            Separated(partition, residual, found.outputs[self._dwell])
            for (partition, residual), found in zip(
                self._targets, each[len(self._layouts) :], strict=True
            )
        )
        return PaperRun(
            self._data, self._dwell, self._partition, self._linear, networks, self._layout,
            poses, (dealt[0], dealt[1]),
        )  # fmt: skip

    def _fitted(self, method: Method, partition: Partition) -> LinearFit:
        best = np.inf
        for _ in range(TIMED):
            model = StaticLinear(
                method=method, form="paper", rows="samples", current_term=True,
                alpha=self._alpha, weights=self._weights,
            )  # fmt: skip
            begin = time.process_time()
            model.fit(partition.training, self._robot)
            best = min(best, time.process_time() - begin)
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
class Networks:
    """The networks of all joints, trained.

    Attributes:
        outputs: (S, n) at every dwell.
        seconds: (n,) each took of one core.
        epochs: (n,) done until no step lowered the cost any more, or all there were.
        weights: Number of weights of each.
    """

    outputs: FloatArray
    seconds: FloatArray
    epochs: IntArray
    weights: int


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


S_PER_PRODUCT = 3e-11
"""Seconds per number multiplied in a training, about: the longest trainings begin first."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """How the networks of the paper protocol are trained: no early stop, as in the paper.

    Attributes:
        epochs: Of Levenberg–Marquardt.
        seed: Of the start weights.
        linear_first: Whether the first hidden layer is linear, as the paper's text has it.
    """

    epochs: int
    seed: int
    linear_first: bool

    def mlp(self, layers: Sequence[int]) -> Mlp:
        """A network of some layout."""
        hidden = ["tanh"] * (len(layers) - 2)
        if self.linear_first and hidden:
            hidden[0] = "linear"
        return Mlp(layers, [*hidden, "linear"])


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What six networks are to learn.

    Attributes:
        inputs: (S, 4) q2…q5 of every dwell, means of its samples.
        values: (N, n) what the linear model leaves of the training samples.
        dwell: (N,) dwell of each.
    """

    inputs: FloatArray
    values: FloatArray
    dwell: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """One network, trained: (S,) outputs at every dwell, seconds of one core, epochs, weights."""

    outputs: FloatArray
    seconds: float
    epochs: int
    weights: int


def network_tasks(
    target: Target, layers: Sequence[int], settings: NetworkSettings, joints: Sequence[int]
) -> list[Task]:
    """One training per joint."""
    mlp = settings.mlp(layers)
    rows = len(target.inputs)
    cost = S_PER_PRODUCT * settings.epochs * rows * mlp.n_weights * min(rows, mlp.n_weights)
    return [Task(partial(_trained, mlp, target, joint, settings), cost) for joint in joints]


def _trained(mlp: Mlp, target: Target, joint: int, settings: NetworkSettings) -> NetworkResult:
    begin = time.process_time()
    with warnings.catch_warnings():
        # A joint that never moved is among the study's own warnings.
        warnings.simplefilter("ignore", ConstantInputWarning)
        trained = train(
            mlp, target.inputs[target.dwell], target.values[:, joint], groups=target.dwell,
            initial=mlp.initial(settings.seed, joint)[None], epochs=settings.epochs,
        )  # fmt: skip
    outputs = trained.predict(target.inputs)[:, 0]
    seconds = time.process_time() - begin
    return NetworkResult(outputs, seconds, trained.histories[0].epochs, mlp.n_weights)


def gathered(found: Sequence[NetworkResult]) -> Networks:
    """The results of `network_tasks`, put together."""
    outputs = np.stack([one.outputs for one in found], axis=1)
    seconds = np.array([one.seconds for one in found])
    epochs = np.array([one.epochs for one in found])
    return Networks(outputs, seconds, epochs, found[0].weights)
