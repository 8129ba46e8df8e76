"""The static paper's protocol, computed: eq. 20, split by sample, networks on what it leaves.

Everything here departs from an honest evaluation on purpose, to be compared with the paper: the
measured current is among the inputs, and each pose is on both sides of the split.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from hil.core import DataError, FitError, FloatArray
from hil.estimators import Method, StaticLinear, Weights
from hil.studies.separation_data import Recording, dwell_means, one_per_pose
from hil.studies.separation_networks import (
    NetworkResult,
    NetworkSettings,
    Target,
    gathered,
    network_tasks,
)
from hil.studies.separation_paper_run import Layout, LinearFit, PaperRun, Separated
from hil.studies.separation_split import Partition, by_pose, by_sample
from hil.studies.separation_tasks import Task

METHODS: tuple[Method, ...] = ("ls", "ridge", "lasso", "elastic-net", "wls")
INPUTS = slice(1, 5)
"""q2…q5, what the paper's networks see."""

TIMED = 3
"""Fits of which the fastest is reported: the first one also loads libraries."""


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
