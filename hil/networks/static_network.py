"""Gravity by least squares, and what it leaves by one network per joint (static paper, II.C).

The networks are trained by our own Levenberg–Marquardt (`hil.networks.lm`) on the residual current
of the dwells. With the joint positions as their only inputs they can learn what friction does on
average over poses like these, but not which way it is stuck: that depends on how the pose was
approached. `inputs` can hold the approach and the history of a dwell as well.

A network of 741 weights remembers 650 poses without effort, so training stops by poses that are
held out from it (`validation_percent`), whole poses, not samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray, IntArray, SpecError
from hil.data import Dataset, Prediction, Stream
from hil.dynamics import RobotModel
from hil.estimators import (
    Form,
    MemorylessStream,
    StaticModel,
    choice,
    flag,
    number,
    one_row_each,
    whole,
)
from hil.networks.lm.arrays import Precision
from hil.networks.lm.network import Mlp
from hil.networks.lm.settings import Settings
from hil.networks.lm.train import train
from hil.networks.lm.trained import Callback
from hil.networks.network_inputs import (
    checked_names,
    network_inputs,
    position_inputs,
    positions_only,
    require_layout,
)
from hil.networks.network_result import NetworkResult, arrays_of, held_out_poses, networks_from

FRICTION = "friction"


class StaticMlpLm(StaticModel):
    """Gravity, offset and friction of an arm at rest.

    Args:
        layers: Units per layer of every joint's network, inputs first.
        activations: One per layer behind the inputs; None is tanh, and a linear output.
        inputs: What the networks see, see `hil.networks.network_inputs`.
        epochs: Of training, at most.
        validation_percent: Of the training poses, held out from the networks to stop by; 0: none.
            The gravity fit sees them.
        patience: Epochs without a better validation error until a network stops.
        weight_decay: Times the sum of squared weights, beside the mean square error of the
            standardised residual.
        averaging: Train on one row per dwell, weighted by its samples: the same minimum.
        form: `shared` or `paper`, as in `StaticWls`.
        current_term: As in `StaticWls`.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.
        precision: `float64`, or `float32` for the Jacobian and its products.
        device: `cpu` or `cuda`.
        seed: Of start weights and held-out poses.
        jobs: Processes to spread the joints over; the result does not depend on it.

    Attributes:
        networks_: The trained networks, one per joint.
        results_: How their training went.
        sigma_: (n,) RMSE at the held-out poses; without any, at the training poses, which is less
            than at others.
        callback: Told every epoch of every joint while it fits; not stored.
    """

    estimator: ClassVar[str] = "static-mlp-lm"
    tells_friction: ClassVar[bool] = True
    callback: Callback | None = None

    def __init__(
        self,
        *,
        layers: Sequence[int] = (4, 20, 20, 10, 1),
        activations: Sequence[str] | None = None,
        inputs: Sequence[str] = ("q2", "q3", "q4", "q5"),
        epochs: int = 1000,
        validation_percent: float = 10.0,
        patience: int = 50,
        weight_decay: float = 0.0,
        averaging: bool = True,
        form: Form = "shared",
        current_term: bool = False,
        rest_speed: float = 0.01,
        precision: Precision = "float64",
        device: str = "cpu",
        seed: int = 0,
        jobs: int = 1,
    ) -> None:
        self.layers = layers
        self.activations = activations
        self.inputs = checked_names(inputs)
        self.epochs = whole("epochs", epochs, at_least=1)
        self.validation_percent = number("validation_percent", validation_percent, at_least=0.0)
        self.patience = whole("patience", patience, at_least=1)
        self.weight_decay = number("weight_decay", weight_decay, at_least=0.0)
        self.averaging = flag("averaging", averaging)
        self.form = choice("form", form, ("shared", "paper"))
        self.current_term = flag("current_term", current_term)
        self.rest_speed = number("rest_speed", rest_speed, above=0.0)
        self.precision = precision
        self.device = device
        self.seed = whole("seed", seed, at_least=0)
        self.jobs = whole("jobs", jobs, at_least=1)
        self._require_form()
        self._mlp = Mlp(layers, activations)
        Settings.given(self._settings())
        if validation_percent >= 100.0:
            raise SpecError(
                f"validation_percent is {validation_percent:g}, but must be below 100",
                hint="20 is usual",
            )

    def extras(self) -> dict[str, str]:
        """PyTorch on any device but the CPU."""
        return {} if self.device == "cpu" else {"learn": f"for device: {self.device}"}

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit gravity and offset to the dwells, then the networks to what they leave.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, or lack an
                input; or no pose could be held out.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.needs(robot).require(dwells=self.samples_)
        self._solve(one_row_each(dwells), weighted=True)
        self._train(dwells)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Gravity, offset, friction and payload per row; rows in motion are not valid.

        Raises:
            DataError: The data are of another robot or unit, or lack an input.
            FitError: A load is mounted, and the fit knew no drive gains.
        """
        base = super().predict(dataset)
        friction = self.networks_.predict(network_inputs(dataset, self.inputs))
        effort = base.effort + friction
        valid = base.valid & np.isfinite(effort)
        return Prediction(effort, base.std, valid, {**base.components, FRICTION: friction})

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time.

        Raises:
            FitError: The networks need more than the joint positions, or see `StaticWls.stream`.
        """
        super().stream(payload)
        if not positions_only(self.inputs):
            raise FitError(
                f"a network with the inputs {', '.join(self.inputs)} cannot be streamed: a stream "
                "knows the motion only",
                hint="fit with inputs from q alone, or predict whole datasets",
            )
        return MemorylessStream(
            self.robot_.n, self._parts_and_friction, self._load_effort, payload or Payload()
        )

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of gravity and offset, and the networks' weights and scaling."""
        return super().fitted_arrays() | arrays_of(self.networks_)

    def fitted_facts(self) -> dict[str, Any]:
        """Those of gravity and offset, and how each network's training went."""
        networks = zip(self.joint_names_, self.results_, strict=True)
        told = [{"joint": joint} | asdict(result) for joint, result in networks]
        return super().fitted_facts() | {"networks": told}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.networks_ = networks_from(self._mlp, arrays)
        self.results_ = tuple(NetworkResult.restored(fact) for fact in facts["networks"])

    def _train(self, dwells: Dataset) -> None:
        """Networks for what gravity and offset leave of the dwells."""
        training, held_out = held_out_poses(dwells, self.validation_percent, self.seed)
        X, Y, groups = self._rows(training)
        require_layout(X, self._mlp.inputs, self.inputs)
        validation = None if held_out is None else self._rows(held_out)
        self.networks_ = train(
            self._mlp, X, Y, groups=groups if self.averaging else None,
            validation=validation and (validation[0], validation[1], None, validation[2]),
            seed=self.seed, jobs=self.jobs, callback=self.callback, **self._settings(),
        )  # fmt: skip
        self.results_ = tuple(NetworkResult.of(h) for h in self.networks_.histories)
        self.sigma_ = np.array([r.validation_rmse or r.train_rmse for r in self.results_])

    def _rows(self, dwells: Dataset) -> tuple[FloatArray, FloatArray, IntArray]:
        """Inputs, residual (N, n) and number of the dwell of every row."""
        residual = dwells["effort"] - super().predict(dwells).effort
        return network_inputs(dwells, self.inputs), residual, dwells.series_index()

    def _parts_and_friction(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        friction = self.networks_.predict(position_inputs(q, self.inputs))
        return self._parts(q, qd, qdd) | {FRICTION: friction}

    def _settings(self) -> dict[str, Any]:
        return {
            "epochs": self.epochs,
            "patience": self.patience if self.validation_percent > 0 else None,
            "weight_decay": self.weight_decay,
            "precision": self.precision,
            "device": self.device,
        }
