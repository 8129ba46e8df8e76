"""Gravity by least squares, and one network per joint for the residual (static paper, II.C).

The networks are trained by the Levenberg–Marquardt method (`hil.networks.lm`) on the residual
current of the dwells. With the joint positions as the only inputs, the networks can learn the
average friction over similar poses, but not the direction of the friction, which depends on how the
pose was approached. The parameter `inputs` can therefore contain further inputs besides positions:

- `q2`: a column of the dataset and the number of a joint, from 1;
- `approach`: approach direction +1 or −1 of the pose; 0 if it is not known;
- `history`: any other complete column (N, n) of the dataset, which gives n inputs;
- `own:history`: the value of the network's own joint in such a column, which gives 1 input.

The effort is not permitted as an input in any form, because a network with the motor current as
input does not predict the current, but copies it. The commanded effort is not permitted as an input
either, because at standstill the commanded effort is the measured effort without noise.

A network with 741 weights easily overfits 650 poses. Training therefore stops early by the error on
held-out poses (`validation_percent`), which are complete poses and not single samples.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray, IntArray, SpecError
from hil.data import Dataset, Prediction, Stream, split
from hil.dynamics import RobotModel
from hil.estimators import (
    Form,
    MemorylessStream,
    StaticModel,
    as_given,
    choice,
    flag,
    number,
    one_row_each,
    parameter,
    whole,
)
from hil.networks.lm import Callback, History, Scaling, Settings, Trained, train
from hil.networks.mlp import Mlp, Precision

FRICTION = "friction"


TARGETS = ("effort", "current", "torque")
"""Words in the names of columns that are, or are derived from, the predicted quantity."""


def checked_names(parameter_name: str, names: Any) -> list[str]:
    """Return the names of inputs as a list.

    Raises:
        SpecError: The value is not a list of names, is empty, contains a name twice, or contains
            the effort.
    """
    if isinstance(names, str) or not isinstance(names, list | tuple) or not names:
        raise SpecError(
            f"{parameter_name} is {names!r}, but must be a list of names such as [q2, approach]"
        )
    wrong = [name for name in names if not isinstance(name, str) or not name]
    if wrong:
        raise SpecError(f"{parameter_name}: {wrong[0]!r} is not a column name")
    if len(set(names)) != len(names):
        raise SpecError(f"{parameter_name}: {max(names, key=names.count)} is listed twice")
    _require_no_target(names)
    return list(names)


def _require_no_target(names: list[str] | tuple[str, ...]) -> None:
    for name in names:
        if any(target in name.lower() for target in TARGETS):
            raise SpecError(
                f"inputs: {name!r} is the effort that the model predicts, or is computed from it",
                hint="use positions, velocities, temperature, approach, or your own columns that "
                "are known without measuring or commanding an effort",
            )


class StaticMlpLm(StaticModel):
    """Estimator of gravity, offset and friction of a static arm.

    Attributes:
        networks_: Trained networks, one per joint.
        results_: Training result of each network.
        sigma_: (n,) RMSE on the held-out poses. Without held-out poses, `sigma_` is the RMSE on the
            training poses, which is lower than on other poses.
        callback: Function that is called with every epoch of every joint; not stored.
    """

    estimator: ClassVar[str] = "static-mlp-lm"
    tells_friction: ClassVar[bool] = True
    callback: Callback | None = None

    layers: Sequence[int] = parameter(
        (4, 20, 20, 10, 1),
        as_given,
        doc="Number of units per layer of each joint's network, inputs first.",
    )
    activations: Sequence[str] | None = parameter(
        None,
        as_given,
        doc="Activation per layer after the inputs; None: tanh, and a linear output.",
    )
    inputs: list[str] = parameter(
        ("q2", "q3", "q4", "q5"),
        checked_names,
        doc="Inputs of the networks, see `hil.networks.static_network`.",
    )
    epochs: int = parameter(1000, whole, at_least=1, doc="Maximum number of epochs.")
    validation_percent: float = parameter(
        10.0,
        number,
        at_least=0.0,
        doc="Percentage of the training poses that is held out from the networks for early "
        "stopping; 0: none. The gravity fit uses these poses.",
    )
    patience: int = parameter(
        50,
        whole,
        at_least=1,
        doc="Number of epochs without a better validation error after which a network stops.",
    )
    weight_decay: float = parameter(
        0.0,
        number,
        at_least=0.0,
        doc="Factor of the sum of squared weights, which is added to the mean square error of "
        "the standardised residual.",
    )
    averaging: bool = parameter(
        True,
        flag,
        doc="Whether to train on one row per dwell, weighted by its number of "
        "samples; the minimum is the same.",
    )
    form: Form = parameter(
        "shared", choice, ("shared", "paper"), doc="`shared` or `paper`, as in `StaticWls`."
    )
    current_term: bool = parameter(False, flag, doc="As in `StaticWls`.")
    rest_speed: float = parameter(
        0.01,
        number,
        above=0.0,
        doc="Maximum speed [rad/s] of a row at standstill; the model is not valid above this "
        "speed.",
    )
    precision: Precision = parameter(
        "float64", as_given, doc="`float64`, or `float32` for the Jacobian and its products."
    )
    device: str = parameter("cpu", as_given, doc="`cpu` or `cuda`.")
    seed: int = parameter(
        0, whole, at_least=0, doc="Random seed of initial weights and held-out poses."
    )
    jobs: int = parameter(
        1,
        whole,
        at_least=1,
        doc="Number of processes for the joints; the result does not depend on it.",
    )

    def _check_together(self) -> None:
        super()._check_together()
        _ = self._mlp  # raises if layers and activations do not match
        Settings.given(self._settings())
        if self.validation_percent >= 100.0:
            raise SpecError(
                f"validation_percent is {self.validation_percent:g}, but must be below 100",
                hint="20 is a usual value",
            )

    @property
    def _mlp(self) -> Mlp:
        return Mlp(self.layers, self.activations)

    def extras(self) -> dict[str, str]:
        """Return the optional extra for PyTorch, which is needed on any device but the CPU."""
        return {} if self.device == "cpu" else {"learn": f"for device: {self.device}"}

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit gravity and offset to the dwells, then the networks to the residual.

        Raises:
            FitError: The data are too few, not finite, of a different robot or unit, or lack an
                input; or no pose could be held out.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.needs(robot).require(dwells=self.samples_)
        self._solve(one_row_each(dwells), weighted=True)
        self._train(dwells)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Return gravity, offset, friction and payload per row; rows in motion are not valid.

        Raises:
            DataError: The data belong to a different robot or unit, or lack an input.
            FitError: A load is mounted and the model has no drive gains; or the number of inputs
                differs from the first layer.
        """
        base = super().predict(dataset)
        X = network_inputs(dataset, self.inputs)
        require_layout(X, self._mlp.inputs, self.inputs)
        friction = self.networks_.predict(X)
        effort = base.effort + friction
        valid = base.valid & np.isfinite(effort)
        return Prediction(effort, base.std, valid, {**base.components, FRICTION: friction})

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time.

        Raises:
            FitError: The networks have inputs other than joint positions, or `StaticWls.stream`
                raises.
        """
        super().stream(payload)
        if not positions_only(self.inputs):
            raise FitError(
                f"a network with the inputs {', '.join(self.inputs)} cannot be streamed: a "
                "stream has only the motion as input",
                hint="fit with position inputs only, or predict whole datasets",
            )
        return MemorylessStream(
            self.robot_.n, self._parts_and_friction, self._load_effort, payload or Payload()
        )

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of gravity and offset, and the weights and scaling of the networks."""
        return super().fitted_arrays() | arrays_of(self.networks_)

    def fitted_facts(self) -> dict[str, Any]:
        """Return the facts of gravity and offset, and the training result of each network."""
        networks = zip(self.joint_names_, self.results_, strict=True)
        told = [{"joint": joint} | asdict(result) for joint, result in networks]
        return super().fitted_facts() | {"networks": told}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fit from the results of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.networks_ = networks_from(self._mlp, arrays)
        self.results_ = tuple(NetworkResult.restored(fact) for fact in facts["networks"])

    def _train(self, dwells: Dataset) -> None:
        """Train the networks on the residual of gravity and offset at the dwells."""
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
        """Return the inputs, the residual (N, n) and the dwell number of every row."""
        residual = dwells["effort"] - super().predict(dwells).effort
        return network_inputs(dwells, self.inputs), residual, dwells.series_index()

    def _parts_and_friction(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        X = position_inputs(q, self.inputs)
        require_layout(X, self._mlp.inputs, self.inputs)
        friction = self.networks_.predict(X)
        return self._parts(q, qd, qdd) | {FRICTION: friction}

    def _settings(self) -> dict[str, Any]:
        return {
            "epochs": self.epochs,
            "patience": self.patience if self.validation_percent > 0 else None,
            "weight_decay": self.weight_decay,
            "precision": self.precision,
            "device": self.device,
        }


APPROACH = "approach"
OWN = "own:"


def positions_only(names: list[str]) -> bool:
    """Return whether all named inputs are joint positions."""
    return all(name == "q" or re.fullmatch(r"q\d+", name) for name in names)


def position_inputs(q: FloatArray, names: list[str]) -> FloatArray:
    """Return the inputs (N, d) from positions (N, n); all input names must be joint positions."""
    return np.concatenate(
        [q if name == "q" else q[:, int(name[1:]) - 1, None] for name in names], 1
    )


def network_inputs(dataset: Dataset, names: list[str]) -> FloatArray:
    """Return the inputs (N, d), or (n, N, d) if joints have different inputs.

    Raises:
        DataError: The dataset lacks a named column, or the robot lacks a numbered joint.
    """
    parts = [_columns(dataset, name) for name in names]
    if all(part.ndim == 2 for part in parts):
        return np.concatenate(parts, axis=1)
    joints = dataset.n_joints
    shared = [np.broadcast_to(p, (joints, *p.shape)) if p.ndim == 2 else p for p in parts]
    return np.concatenate(shared, axis=2)


_NUMBERED = re.compile(r"([A-Za-z_]+)(\d+)")


def _columns(dataset: Dataset, name: str) -> FloatArray:
    """Return a single input as (N, k), or as (n, N, 1) if joints have different values."""
    if name.startswith(OWN):
        values = _column(dataset, name.removeprefix(OWN))
        if values.shape[1] != dataset.n_joints:
            raise DataError(f"input {name}: the column does not have one value per joint")
        return np.ascontiguousarray(values.T)[:, :, None]
    numbered = _NUMBERED.fullmatch(name)
    if name == APPROACH or name in dataset.columns or numbered is None:
        return _column(dataset, name)
    values, joint = _column(dataset, numbered[1]), int(numbered[2])
    if not 1 <= joint <= values.shape[1]:
        raise DataError(
            f"input {name}: there is no joint {joint}",
            hint=f"joints are numbered from 1 to {values.shape[1]}",
        )
    return values[:, joint - 1 : joint]


def _column(dataset: Dataset, name: str) -> FloatArray:
    """Return a column as (N, k)."""
    if name == APPROACH and name not in dataset.columns:
        sides = np.array([c.approach for c in dataset.conditions], dtype=np.float64)
        return sides[dataset.series_index()][:, None]
    try:
        values = dataset[name]
    except DataError as error:
        raise DataError(
            f"input {name!r} of the network: {error.message}", hint=error.hint
        ) from error
    return values if values.ndim == 2 else values[:, None]


def require_layout(X: FloatArray, first: int, names: list[str]) -> None:
    """Raise if the number of inputs d of (N, d) or (n, N, d) differs from the first layer.

    Raises:
        FitError: The number of inputs differs from the first layer.
    """
    if X.shape[-1] != first:
        raise FitError(
            f"layers begins with {first}, but the network has {X.shape[-1]} inputs: "
            f"{', '.join(names)}",
            hint=f"use layers: [{X.shape[-1]}, …]",
        )


@dataclass(frozen=True, slots=True)
class NetworkResult:
    """Training result of the network of one joint, as stored in `model.json`.

    Attributes:
        epochs: Number of completed epochs.
        best_epoch: Number of the epoch whose weights are used.
        stopped: Reason for the end of the training, see `hil.networks.lm.History`.
        train_rmse, validation_rmse: Errors of the used weights over all training or validation
            rows, in effort units; the validation error is None without validation poses.
    """

    epochs: int
    best_epoch: int
    stopped: str
    train_rmse: float
    validation_rmse: float | None

    @staticmethod
    def of(history: History) -> NetworkResult:
        """Return the training result that corresponds to a training history."""
        held_out = history.final_validation_rmse
        return NetworkResult(
            history.epochs, history.best_epoch, history.stopped, history.final_train_rmse,
            held_out if np.isfinite(held_out) else None,
        )  # fmt: skip

    @staticmethod
    def restored(fact: dict[str, Any]) -> NetworkResult:
        """Return the training result from the entry of one network in `model.json`."""
        return NetworkResult(**{each.name: fact[each.name] for each in fields(NetworkResult)})


_SCALING = tuple(each.name for each in fields(Scaling))


def arrays_of(networks: Trained) -> dict[str, FloatArray]:
    """Return the weights and the scaling of the networks by their names in a model file."""
    scaling = {name: getattr(networks.scaling, name) for name in _SCALING}
    arrays = {"weights": networks.weights, **scaling}
    return {f"network.{name}": values for name, values in arrays.items()}


def networks_from(mlp: Mlp, arrays: dict[str, FloatArray]) -> Trained:
    """Return the networks from the result of `arrays_of`, without training histories."""
    scaling = Scaling(**{name: arrays[f"network.{name}"] for name in _SCALING})
    weights = arrays["network.weights"]
    if weights.shape[1:] != (mlp.n_weights,) or scaling.input_mean.shape[1:] != (mlp.inputs,):
        raise ValueError(f"network.weights: the shape does not match a network {mlp}")
    return Trained(mlp, weights, scaling)


def held_out_poses(dwells: Dataset, percent: float, seed: int) -> tuple[Dataset, Dataset | None]:
    """Return the training dwells and the validation dwells, by complete poses; None with 0 %.

    Raises:
        FitError: There are not enough poses to hold some out.
    """
    if percent == 0:
        return dwells, None
    try:
        parts = split(dwells, "pose", percent / 100.0, seed)
    except DataError as error:
        raise FitError(
            f"no poses can be held out for early stopping: {error.message}",
            hint="use more poses, or validation_percent: 0",
        ) from error
    return parts.train, parts.test
