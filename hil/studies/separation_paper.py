"""Protocol of the static paper: eq. 20, split by sample, and networks fitted to the residual.

This protocol departs from an honest evaluation on purpose, for comparison with the paper: the
measured current is an input of the models, and samples of each pose are both in the training and in
the test part. `PaperProtocol` fits the five linear methods, lists the training tasks of the
networks, and combines the results into a `PaperRun`, which computes the errors.
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
"""Joints q2…q5, whose angles are the inputs of the networks in the static paper."""

TIMED = 3
"""Number of times that a fit is repeated; the duration of the fastest repetition is reported.

The first repetition also loads libraries and is therefore slower.
"""

Layout = tuple[int, ...]


class PaperProtocol:
    """Linear fits and network trainings of the protocol of the static paper.

    Args:
        recording: Usable dwells of the run.
        layouts: Network layouts that are compared.
        layout: Network layout that Table 4 and the figures show.
        settings: Settings of the network trainings.
        alpha: Weight of the penalty in ridge, LASSO and elastic-net regression.
        weights: Weighting of the rows in the WLS fit.

    Raises:
        FitError: The data are not sufficient, or eq. 15 of the static paper does not apply to the
            robot.
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
        """Return one task per network training, in the order in which `gather` expects them."""
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
        """Combine the results of the tasks returned by `tasks`."""
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
        """Exchange the mean residuals of the dwells at random between the dwells.

        The exchange does not change the scatter of the samples within each dwell.
        """
        means = dwell_means(self._data, residual)
        order = np.random.default_rng([self._settings.seed, 2]).permutation(len(means))
        moved: FloatArray = residual + (means[order] - means)[self._dwell]
        return moved


@dataclass(frozen=True, slots=True, eq=False)
class LinearFit:
    """Fit of one of the five linear methods to eq. 20.

    Attributes:
        model: Linear model fitted to the training rows.
        estimate: (N, n) estimated current of every row.
        seconds: CPU time of the fit on one core [s].
    """

    model: StaticLinear
    estimate: FloatArray
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Separated:
    """Model with gravity from WLS and friction from networks, for one split and one target.

    Attributes:
        partition: Row numbers of the training, test and validation parts.
        residual: (N, n) residual of the WLS fit, or values that replace this residual in a
            comparison.
        friction: (N, n) friction predicted by the networks.
    """

    partition: Partition
    residual: FloatArray
    friction: FloatArray

    def rmse(self, rows: IntArray) -> FloatArray:
        """Return the (n,) RMSE of the complete model at the given rows."""
        return rmse(self.residual[rows], self.friction[rows])

    @property
    def train(self) -> FloatArray:
        """(n,) RMSE of the complete model at the training rows."""
        return self.rmse(self.partition.train)

    @property
    def test(self) -> FloatArray:
        """(n,) RMSE of the complete model at the test rows."""
        return self.rmse(self.partition.test)


@dataclass(frozen=True, slots=True, eq=False)
class Networks:
    """Trained networks of all joints.

    Attributes:
        outputs: (S, n) outputs of the networks at every dwell.
        seconds: (n,) CPU time of each training on one core [s].
        epochs: (n,) number of epochs until no step reduced the cost any further, or the maximum
            number.
        weights: Number of weights of each network.
    """

    outputs: FloatArray
    seconds: FloatArray
    epochs: IntArray
    weights: int


@dataclass(frozen=True, slots=True, eq=False)
class PaperRun:
    """Results under the protocol of the static paper.

    Attributes:
        data: Dataset with one dwell per pose.
        dwell: (N,) dwell number of each row.
        partition: Split of the rows by sample.
        linear: Fits of the five linear methods, by method name.
        networks: Trained networks, by network layout.
        layout: Network layout that Table 4 and the figures show.
        poses_held_out: Results if whole poses are held out.
        dealt: Results if the friction values are exchanged at random among the poses, split by
            sample and by pose.
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
        """WLS fit whose residual is the target of the networks."""
        return self.linear["wls"]

    @property
    def residual(self) -> FloatArray:
        """(N, n) residual of WLS."""
        return np.asarray(self.data["effort"] - self.wls.estimate)

    def separated(self, layout: Layout | None = None) -> Separated:
        """Return the WLS fit combined with the networks of a layout; by default that of Table 4."""
        friction = self.networks[layout or self.layout].outputs[self.dwell]
        return Separated(self.partition, self.residual, friction)

    def linear_rmse(self, method: Method, rows: IntArray) -> FloatArray:
        """Return the (n,) RMSE of one of the five linear methods at the given rows."""
        return rmse(self.data["effort"][rows], self.linear[method].estimate[rows])

    def means_rmse(self, rows: IntArray | None = None) -> FloatArray:
        """Return the (n,) RMSE of the errors averaged over each dwell.

        Args:
            rows: Row numbers to evaluate; None selects all rows.
        """
        one = self.separated()
        chosen = np.arange(len(self.dwell)) if rows is None else rows
        error = (one.residual - one.friction)[chosen]
        _, number = np.unique(self.dwell[chosen], return_inverse=True)
        sums = np.zeros((int(number.max(initial=-1)) + 1, error.shape[1]))
        np.add.at(sums, number, error)
        means = sums / np.bincount(number)[:, None]
        return rmse(means, np.zeros_like(means))

    def residual_noise(self) -> FloatArray:
        """Return the (n,) scatter of the WLS residual within the dwells.

        The scatter within the dwells is the lower bound of the error of any function of the pose.
        """
        return sample_noise(self.data.with_columns(effort=self.residual))

    def beyond_noise(self) -> FloatArray:
        """Return (n,) √(test² − noise²), approximately the RMSE relative to the dwell mean."""
        square = self.separated().test ** 2 - self.residual_noise() ** 2
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def explained(self, joint: int) -> float:
        """Return the share of the variance of test currents that WLS on eq. 20 explains."""
        rows = self.partition.test
        variance = float(np.var(self.data["effort"][rows, joint]))
        left = float(self.linear_rmse("wls", rows)[joint]) ** 2
        return 1.0 - left / variance if variance > 0 else float("nan")


S_PER_PRODUCT = 3e-11
"""Approximate time per multiplication in a network training [s].

The estimated training time is used to start the longest trainings first.
"""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Training settings of the networks of the static paper, without early stopping.

    Attributes:
        epochs: Number of Levenberg–Marquardt epochs.
        seed: Random seed of the initial weights of the networks.
        linear_first: Whether the first hidden layer is linear, as in the text of the static paper.
    """

    epochs: int
    seed: int
    linear_first: bool

    def mlp(self, layers: Sequence[int]) -> Mlp:
        """Return an untrained network with the given layers."""
        hidden = ["tanh"] * (len(layers) - 2)
        if self.linear_first and hidden:
            hidden[0] = "linear"
        return Mlp(layers, [*hidden, "linear"])


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Training data of the networks of all joints.

    Attributes:
        inputs: (S, 4) mean angles of the joints q2…q5 in every dwell.
        values: (N, n) residual of the linear model at the training samples.
        dwell: (N,) dwell number of each training sample.
    """

    inputs: FloatArray
    values: FloatArray
    dwell: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """Result of the training of one network.

    Attributes:
        outputs: (S,) outputs of the network at every dwell.
        seconds: CPU time of the training on one core [s].
        epochs: Number of training epochs.
        weights: Number of weights of the network.
    """

    outputs: FloatArray
    seconds: float
    epochs: int
    weights: int


def network_tasks(
    target: Target, layers: Sequence[int], settings: NetworkSettings, joints: Sequence[int]
) -> list[Task]:
    """Return one training task per joint."""
    mlp = settings.mlp(layers)
    rows = len(target.inputs)
    cost = S_PER_PRODUCT * settings.epochs * rows * mlp.n_weights * min(rows, mlp.n_weights)
    return [Task(partial(_trained, mlp, target, joint, settings), cost) for joint in joints]


def _trained(mlp: Mlp, target: Target, joint: int, settings: NetworkSettings) -> NetworkResult:
    begin = time.process_time()
    with warnings.catch_warnings():
        # The study itself warns about a joint that never moved.
        warnings.simplefilter("ignore", ConstantInputWarning)
        trained = train(
            mlp, target.inputs[target.dwell], target.values[:, joint], groups=target.dwell,
            initial=mlp.initial(settings.seed, joint)[None], epochs=settings.epochs,
        )  # fmt: skip
    outputs = trained.predict(target.inputs)[:, 0]
    seconds = time.process_time() - begin
    return NetworkResult(outputs, seconds, trained.histories[0].epochs, mlp.n_weights)


def gathered(found: Sequence[NetworkResult]) -> Networks:
    """Combine the results of the tasks returned by `network_tasks`."""
    outputs = np.stack([one.outputs for one in found], axis=1)
    seconds = np.array([one.seconds for one in found])
    epochs = np.array([one.epochs for one in found])
    return Networks(outputs, seconds, epochs, found[0].weights)
