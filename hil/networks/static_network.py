"""Gravity by least squares, and what it leaves by one network per joint (static paper, II.C).

The networks are trained by our own Levenberg–Marquardt (`hil.networks.lm`) on the residual current
of the dwells. With the joint positions as their only inputs they can learn what friction does on
average over poses like these, but not which way it is stuck: that depends on how the pose was
approached. `inputs` can therefore hold more than positions:

- `q2`: a column of the dataset and the number of a joint, from 1;
- `approach`: +1 or −1, from which side the pose was approached; 0 where that is not known;
- `history`: any other column (N, n) of the dataset as a whole, n inputs;
- `own:history`: of such a column only the joint whose network it is, 1 input.

Not the effort itself, in none of its forms: a network that is shown the current predicts nothing.
The commanded effort is no better: at rest it is the measured one without the noise.

A network of 741 weights remembers 650 poses without effort, so training stops by poses that are
held out from it (`validation_percent`), whole poses, not samples.
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
"""Columns whose names hold one of these are what is to be predicted, or made of it."""


def checked_names(parameter_name: str, names: Any) -> list[str]:
    """Names as a list.

    Raises:
        SpecError: It is no list of names, is empty, a name occurs twice, or it is the effort.
    """
    if isinstance(names, str) or not isinstance(names, list | tuple) or not names:
        raise SpecError(
            f"{parameter_name} is {names!r}, but must be a list of names such as [q2, approach]"
        )
    wrong = [name for name in names if not isinstance(name, str) or not name]
    if wrong:
        raise SpecError(f"{parameter_name}: {wrong[0]!r} is no name of a column")
    if len(set(names)) != len(names):
        raise SpecError(f"{parameter_name}: {max(names, key=names.count)} is there twice")
    _require_no_target(names)
    return list(names)


def _require_no_target(names: list[str] | tuple[str, ...]) -> None:
    for name in names:
        if any(target in name.lower() for target in TARGETS):
            raise SpecError(
                f"inputs: {name!r} is the effort that is to be predicted, or made of it: the model "
                "would be given its answer",
                hint="use positions, velocities, temperature, approach, or columns of your own "
                "that are known without measuring or commanding an effort",
            )


class StaticMlpLm(StaticModel):
    """Gravity, offset and friction of an arm at rest.

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

    layers: Sequence[int] = parameter(
        (4, 20, 20, 10, 1), as_given, doc="Units per layer of every joint's network, inputs first."
    )
    activations: Sequence[str] | None = parameter(
        None, as_given, doc="One per layer behind the inputs; None is tanh, and a linear output."
    )
    inputs: list[str] = parameter(
        ("q2", "q3", "q4", "q5"),
        checked_names,
        doc="What the networks see, see `hil.networks.static_network`.",
    )
    epochs: int = parameter(1000, whole, at_least=1, doc="Of training, at most.")
    validation_percent: float = parameter(
        10.0,
        number,
        at_least=0.0,
        doc="Of the training poses, held out from the networks to stop by; 0: none. The gravity "
        "fit sees them.",
    )
    patience: int = parameter(
        50, whole, at_least=1, doc="Epochs without a better validation error until a network stops."
    )
    weight_decay: float = parameter(
        0.0,
        number,
        at_least=0.0,
        doc="Times the sum of squared weights, beside the mean square error of the standardised "
        "residual.",
    )
    averaging: bool = parameter(
        True, flag, doc="Train on one row per dwell, weighted by its samples: the same minimum."
    )
    form: Form = parameter(
        "shared", choice, ("shared", "paper"), doc="`shared` or `paper`, as in `StaticWls`."
    )
    current_term: bool = parameter(False, flag, doc="As in `StaticWls`.")
    rest_speed: float = parameter(
        0.01,
        number,
        above=0.0,
        doc="Faster than this [rad/s] a row is not at rest and the model not valid.",
    )
    precision: Precision = parameter(
        "float64", as_given, doc="`float64`, or `float32` for the Jacobian and its products."
    )
    device: str = parameter("cpu", as_given, doc="`cpu` or `cuda`.")
    seed: int = parameter(0, whole, at_least=0, doc="Of start weights and held-out poses.")
    jobs: int = parameter(
        1,
        whole,
        at_least=1,
        doc="Processes to spread the joints over; the result does not depend on it.",
    )

    def _check_together(self) -> None:
        super()._check_together()
        _ = self._mlp  # layers and activations that fit each other
        Settings.given(self._settings())
        if self.validation_percent >= 100.0:
            raise SpecError(
                f"validation_percent is {self.validation_percent:g}, but must be below 100",
                hint="20 is usual",
            )

    @property
    def _mlp(self) -> Mlp:
        return Mlp(self.layers, self.activations)

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
            FitError: A load is mounted, and the fit knew no drive gains; or the model has another
                number of inputs than its layers.
        """
        base = super().predict(dataset)
        X = network_inputs(dataset, self.inputs)
        require_layout(X, self._mlp.inputs, self.inputs)
        friction = self.networks_.predict(X)
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
    """Whether the inputs follow from the joint positions alone."""
    return all(name == "q" or re.fullmatch(r"q\d+", name) for name in names)


def position_inputs(q: FloatArray, names: list[str]) -> FloatArray:
    """(N, d) inputs that follow from positions (N, n) alone, see `positions_only`."""
    return np.concatenate(
        [q if name == "q" else q[:, int(name[1:]) - 1, None] for name in names], 1
    )


def network_inputs(dataset: Dataset, names: list[str]) -> FloatArray:
    """(N, d) inputs, or (n, N, d) when joints have inputs of their own.

    Raises:
        DataError: The dataset has no such column, or the robot no such joint.
    """
    parts = [_columns(dataset, name) for name in names]
    if all(part.ndim == 2 for part in parts):
        return np.concatenate(parts, axis=1)
    joints = dataset.n_joints
    shared = [np.broadcast_to(p, (joints, *p.shape)) if p.ndim == 2 else p for p in parts]
    return np.concatenate(shared, axis=2)


_NUMBERED = re.compile(r"([A-Za-z_]+)(\d+)")


def _columns(dataset: Dataset, name: str) -> FloatArray:
    """(N, k), or (n, N, 1) for a joint's own."""
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
            hint=f"joints are counted from 1 to {values.shape[1]}",
        )
    return values[:, joint - 1 : joint]


def _column(dataset: Dataset, name: str) -> FloatArray:
    """(N, k)."""
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
    """Refuse inputs (N, d) or (n, N, d) that are more or fewer than the first of the layers.

    Raises:
        FitError: They are.
    """
    if X.shape[-1] != first:
        raise FitError(
            f"layers begins with {first}, but {', '.join(names)} are {X.shape[-1]} inputs",
            hint=f"use layers: [{X.shape[-1]}, …]",
        )


@dataclass(frozen=True, slots=True)
class NetworkResult:
    """How the training of one joint's network went, as `model.json` keeps it.

    Attributes:
        epochs: Done.
        best_epoch: Whose weights were kept.
        stopped: Why it ended, see `hil.networks.lm.History`.
        train_rmse, validation_rmse: Of the weights kept, over all rows, in effort units; None
            without validation poses.
    """

    epochs: int
    best_epoch: int
    stopped: str
    train_rmse: float
    validation_rmse: float | None

    @staticmethod
    def of(history: History) -> NetworkResult:
        """From the history of a training."""
        held_out = history.final_validation_rmse
        return NetworkResult(
            history.epochs, history.best_epoch, history.stopped, history.final_train_rmse,
            held_out if np.isfinite(held_out) else None,
        )  # fmt: skip

    @staticmethod
    def restored(fact: dict[str, Any]) -> NetworkResult:
        """From what `model.json` says of one network."""
        return NetworkResult(**{each.name: fact[each.name] for each in fields(NetworkResult)})


_SCALING = tuple(each.name for each in fields(Scaling))


def arrays_of(networks: Trained) -> dict[str, FloatArray]:
    """Weights and scaling, by their names in a model file."""
    scaling = {name: getattr(networks.scaling, name) for name in _SCALING}
    arrays = {"weights": networks.weights, **scaling}
    return {f"network.{name}": values for name, values in arrays.items()}


def networks_from(mlp: Mlp, arrays: dict[str, FloatArray]) -> Trained:
    """Inverse of `arrays_of`; how the training went is not in it."""
    scaling = Scaling(**{name: arrays[f"network.{name}"] for name in _SCALING})
    weights = arrays["network.weights"]
    if weights.shape[1:] != (mlp.n_weights,) or scaling.input_mean.shape[1:] != (mlp.inputs,):
        raise ValueError(f"network.weights: their shape is not that of a network {mlp}")
    return Trained(mlp, weights, scaling)


def held_out_poses(dwells: Dataset, percent: float, seed: int) -> tuple[Dataset, Dataset | None]:
    """Dwells to train on, and those of whole poses to stop by; None with 0 %.

    Raises:
        FitError: There are not enough poses.
    """
    if percent == 0:
        return dwells, None
    try:
        parts = split(dwells, "pose", percent / 100.0, seed)
    except DataError as error:
        raise FitError(
            f"no poses can be held out to stop the training by: {error.message}",
            hint="give more poses, or validation_percent: 0",
        ) from error
    return parts.train, parts.test
