"""Base classes of all robot-model estimators: parameters, fit, prediction and storage.

`estimator` creates an estimator from its registered name. `fit` fits the estimator to a `Dataset`;
the fitted estimator then serves as the model. A fitted estimator predicts the effort of recordings
(`predict`) and of single samples (`stream`). `save` writes a fitted model to a folder, and
`load_model_file` reads a model from such a folder. `RobotEstimator` defines the interface of an
estimator in the style of scikit-learn: parameters are declared (`hil.estimators.parameters`), and
names of fitted attributes end in `_`. `WlsEstimator` is the base of all models whose torque is a
regressor times coefficients; its subclasses define the regressor.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import ValidationError

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray, SpecError, plugins
from hil.data import (
    Conditions,
    Dataset,
    FilterSettings,
    Prediction,
    SeriesKind,
    Stream,
    downsample,
    is_prepared,
    prepare,
    rows_of,
    rows_to_fit,
)
from hil.dynamics import COMPILED_FROM, RobotModel, may_be
from hil.estimators.checks import Needs, require_rank
from hil.estimators.covariance import correlated_samples
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares
from hil.estimators.model_file import (
    ARRAYS_FILE,
    Training,
    read_arrays,
    read_document,
    restore_robot,
    save_model,
)
from hil.estimators.model_folder import MODEL_FILE, only_model
from hil.estimators.parameters import Parametrised, require_known
from hil.estimators.streaming import MemorylessStream

GROUP = "hil.estimators"

HONEST = "honest"
"""Protocol name of models that predict the effort from the motion and the payload alone."""


class RobotEstimator(Parametrised):
    """Base class of all estimators: fits a model of one robot to a `Dataset` and predicts with it.

    Attributes:
        estimator: Name under which the class is registered.
        series_kinds: Kinds of series (dwells, trajectories) that a fit uses, the preferred kind
            first.
        tells_friction: Whether the predictions of the estimator contain the friction as a separate
            component.
        robot_: Robot model to which the estimator was fitted.
        joint_names_: Names of the joints, in the order of the joint axis of every fitted array.
        effort_kind_: Quantity that the model predicts: `current` [A] or `torque` [N·m].
        torque_scale_: (n,) torque per unit of effort; 1 if the effort is a torque.
        gains_source_: Source of the drive gains; empty if the training data have no drive gains.
        sigma_: (n,) standard deviation of the training residual, in effort units.
        samples_: Number of rows (or of dwells, for a static model) that the fit used.
        training_: Summary of the training data; None for older model files.
        notes_: List of notes for the user on how the fit treated irregular data.
    """

    estimator: ClassVar[str] = ""
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)
    tells_friction: ClassVar[bool] = True

    robot_: RobotModel
    joint_names_: tuple[str, ...]
    effort_kind_: str
    torque_scale_: FloatArray
    gains_source_: str
    sigma_: FloatArray
    samples_: int
    training_: Training | None = None
    notes_: tuple[str, ...] = ()

    @property
    def protocol(self) -> str:
        """Protocol of the model: `honest`, or a name for the deviation from an honest model.

        Models that deviate from the honest protocol exist only to reproduce publications. Reports
        show the protocol of a model beside its name. Only models with the honest protocol are
        checked against the criteria of an experiment.
        """
        return HONEST

    @property
    def knows_gains(self) -> bool:
        """Whether the effort that the model predicts can be converted to N·m.

        Drive gains that are all 1 and have no source count as unknown gains.
        """
        without = not self.gains_source_ and bool(np.all(self.torque_scale_ == 1.0))
        return self.effort_kind_ == "torque" or not without

    def extras(self) -> Mapping[str, str]:
        """Return the optional dependencies that a fit needs, mapped to their purpose.

        A run checks these optional dependencies before the robot moves.
        """
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements of a fit.

        A run that would not meet these requirements is refused before it starts. An estimator that
        states no data requirements never causes a run to be refused.

        Args:
            robot: Robot model to be fitted.
            loaded: Whether a payload is mounted in any of the data.

        Raises:
            FitError: The estimator cannot be fitted to data of this robot.
        """
        return Needs()

    @abstractmethod
    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to a dataset."""

    @abstractmethod
    def predict(self, dataset: Dataset) -> Prediction:
        """Predict the effort of every row of a dataset."""

    @abstractmethod
    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, with the declared payload mounted."""

    @abstractmethod
    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the fitted arrays that the model file stores, by name."""

    @abstractmethod
    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from `fitted_arrays` and `fitted_facts`.

        The caller must set `robot_` before this call.
        """

    def fitted_facts(self) -> dict[str, Any]:
        """Return the names and units of the fitted quantities, as values that JSON can store."""
        return {
            "joint_names": list(self.joint_names_),
            "effort_kind": self.effort_kind_,
            "gains_source": self.gains_source_,
            "samples": self.samples_,
            "protocol": self.protocol,
        } | ({"notes": list(self.notes_)} if self.notes_ else {})

    def save(self, folder: Path) -> Path:
        """Write `model.json` and `model.safetensors` into a folder and return the folder."""
        return save_model(self, folder)

    def _remember(self, dataset: Dataset, robot: RobotModel, scale: FloatArray) -> None:
        self.robot_ = robot
        self.joint_names_ = dataset.joint_names
        self.effort_kind_ = dataset.effort_kind
        self.torque_scale_ = scale
        self.gains_source_ = "" if dataset.drive_gains is None else dataset.drive_gains_source
        self.training_ = Training.of(dataset)

    def _restore_common(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        self.joint_names_ = tuple(facts["joint_names"])
        self.effort_kind_ = facts["effort_kind"]
        self.gains_source_ = facts["gains_source"]
        self.samples_ = int(facts["samples"])
        self.notes_ = tuple(str(note) for note in facts.get("notes", ()))
        self.torque_scale_ = arrays["torque_scale"]
        self.sigma_ = arrays["sigma"]

    def require_match(self, dataset: Dataset) -> None:
        """Raise if robot, effort unit or gravity of the data differ from those of the model.

        Raises:
            FitError: The estimator is not fitted yet.
            DataError: Robot, effort unit or gravity of the data differ from those of the model.
                Data that do not name a robot are accepted for the model of any robot.
        """
        if not hasattr(self, "sigma_"):
            raise FitError(f"{self.estimator} is not fitted yet", hint="call fit first")
        if not may_be(dataset.robot, self.robot_):
            raise DataError(
                f"the model is for a {self.robot_.name}, the data are from a {dataset.robot}",
                hint="use a model that was fitted to recordings of the same robot type",
            )
        if dataset.joint_names != self.joint_names_:
            raise DataError(
                f"the model is for the joints {', '.join(self.joint_names_)}, "
                f"the data have {', '.join(dataset.joint_names)}",
                hint="use recordings of the robot that the model was fitted for",
            )
        if dataset.effort_kind != self.effort_kind_:
            raise DataError(
                f"the model predicts a {self.effort_kind_}, the data contain a "
                f"{dataset.effort_kind}",
                hint="fit and evaluate on recordings of the same quantity",
            )
        if not np.allclose(dataset.gravity, self.robot_.gravity_vector, atol=0.05):
            raise DataError(
                f"the model is for gravity {self.robot_.gravity_vector.tolist()} in the base "
                f"frame, the data were recorded under {list(dataset.gravity)} m/s²",
                hint="fit a separate model for each mounting orientation of the arm",
            )


def estimator(name: str, /, **params: Any) -> RobotEstimator:
    """Return a new estimator by its name in the entry-point group `hil.estimators`.

    Raises:
        PluginError: No estimator is registered under this name, or its module cannot be loaded.
        SpecError: A parameter name is unknown to the estimator, or the estimator rejects the value
            of a parameter.
    """
    kind = plugins.load(GROUP, name)
    require_known(params, kind.parameter_names(), name)
    try:
        created: RobotEstimator = kind(**params)
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    except (ValidationError, ValueError, TypeError) as error:
        # Third-party plug-ins may check their parameters without `hil.estimators.parameters`.
        raise SpecError(f"{name}: {_first_line(error)}") from error
    return created


def _first_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where}: {first['msg']}"
    return str(error)


def load_model_file(folder: str | Path) -> RobotEstimator:
    """Return the fitted model that a folder contains, read from its files.

    Args:
        folder: Model folder, or run directory that contains exactly one model.

    Raises:
        DataError: Files of the model are missing or damaged, a newer version of hil wrote the
            files, or the run directory contains several models.
        PluginError: The package that contains the estimator of the model is not installed.
    """
    folder = only_model(Path(folder))
    document = read_document(folder / MODEL_FILE)
    arrays = read_arrays(folder / ARRAYS_FILE, str(document.get("arrays_sha256", "")))
    try:
        model = estimator(_text(document["estimator"]), **document["parameters"])
        model.robot_ = restore_robot(document["robot"], folder)
        model.restore(arrays, document["fitted"])
        require_sound(model)
        # Older versions of hil did not store a summary of the training data.
        if document.get("training"):
            model.training_ = Training.restored(document["training"], arrays)
    except _DAMAGED as error:
        raise DataError(
            f"{folder / MODEL_FILE} is damaged; missing or invalid: {error}",
            hint="fit the model again",
        ) from error
    return model


_DAMAGED = (
    KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, MemoryError,
    SpecError,
)  # fmt: skip
"""Exceptions that a damaged model document can raise, because plug-ins check little of it."""

PREDICTING = frozenset({"coefficients", "rigid", "gear_rigid", "friction", "inertial", "exponent"})
"""Names of the fitted arrays that predictions depend on; every value must be finite."""


def require_sound(model: RobotEstimator) -> None:
    """Raise if joint names, units or fitted values of a loaded model are invalid.

    Raises:
        TypeError, ValueError: A fitted value is invalid; the message contains its name.
    """
    names = [_text(name) for name in model.joint_names_]
    if not np.shape(model.sigma_) == np.shape(model.torque_scale_) == (len(names),):
        raise ValueError(f"joint_names: {len(names)} for {np.size(model.sigma_)} joints")
    if not (np.all(np.isfinite(model.torque_scale_)) and np.all(model.torque_scale_ > 0)):
        raise ValueError(f"torque_scale: {model.torque_scale_.tolist()!s:.60}")
    # An unknown standard deviation is stored as NaN.
    if np.any(np.isinf(model.sigma_) | (model.sigma_ < 0)):
        raise ValueError(f"sigma: {model.sigma_.tolist()!s:.60}")
    for name, values in model.fitted_arrays().items():
        if name in PREDICTING and not np.all(np.isfinite(values)):
            raise ValueError(f"{name} has values that are not finite")
    if model.effort_kind_ not in ("current", "torque"):
        raise ValueError(f"effort_kind: {model.effort_kind_!r:.60}")


def _text(value: object) -> str:
    """Return the value if it is a string.

    Raises:
        TypeError: The value is not a string.
    """
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.60} is not a string")
    return value


def needs_of(plug_in: Any, robot: RobotModel, *, loaded: bool = False) -> Needs:
    """Return the data requirements that an estimator or study states; empty if none are stated."""
    stated = getattr(plug_in, "needs", None)
    needs: Needs = Needs() if stated is None else stated(robot, loaded=loaded)
    return needs


def prepared(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """Return the dataset with filtered columns, which are computed only if they are missing."""
    return dataset if is_prepared(dataset) else prepare(dataset, settings)


def training_rows(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """Return the dataset rows that a fit uses, with filtered columns.

    Rows that are reserved for the evaluation of the model are left out.
    """
    data = downsample(prepared(dataset, settings), settings)
    wanted = rows_to_fit(data)
    return data if np.all(wanted) else rows_of(data, wanted)


CHUNK = 4096
"""Number of samples per block of the regressor; bounds the memory use for long recordings."""

LONG = 65_536
"""Minimum number of samples for the use of compiled regressors, which need larger blocks."""


def chunks(dataset: Dataset) -> Iterator[slice]:
    """Yield consecutive row ranges of limited length that together cover the dataset."""
    size = CHUNK if len(dataset) < LONG else max(CHUNK, COMPILED_FROM)
    for start in range(0, len(dataset), size):
        yield slice(start, min(start + size, len(dataset)))


def payload_torque(
    robot: RobotModel, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> FloatArray:
    """Return (N, n) the torque [N·m] of the payload mounted in each series.

    If a payload was identified for a series, the identified payload replaces the declared payload.
    """
    torque = np.zeros_like(q)
    for condition, rows in dataset.slices():
        load = load_of(condition)
        if not load.is_empty and rows.stop > rows.start:
            torque[rows] = robot.payload_effort(load, q[rows], qd[rows], qdd[rows])
    return torque


def load_of(condition: Conditions) -> Payload:
    """Return the identified payload of a series, or the declared payload if none was identified."""
    return condition.payload_identified or condition.payload


def motion_of(
    model: RobotEstimator, t: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> Dataset:
    """Return a dataset of one series with the given motion, without payload and with zero effort.

    The filtered columns of the dataset contain the unfiltered motion, so that no filter is applied.

    Args:
        model: Fitted model that defines robot, joints, effort kind and gravity.
        t: (N,) time [s].
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s].
        qdd: (N, n) accelerations [rad/s²].
    """
    columns = {"t": t, "q": q, "qd": qd, "effort": np.zeros_like(q)}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": np.zeros_like(q)}
    x, y, z = (float(value) for value in model.robot_.gravity_vector)
    return Dataset(
        robot=model.robot_.name,
        joint_names=model.joint_names_,
        effort_kind="torque" if model.effort_kind_ == "torque" else "current",
        columns=columns,
        offsets=np.array([0, len(t)], dtype=np.int64),
        conditions=(Conditions("asked", "trajectory"),),
        drive_gains=model.torque_scale_,
        gravity=(x, y, z),
    )


def dwells_of(
    model: RobotEstimator, q: FloatArray, load: Payload | None = None, **columns: FloatArray
) -> Dataset:
    """Return a dataset with one dwell of one row at each of the positions `q` (N, n).

    Args:
        model: Fitted model that defines robot, joints, effort kind and gravity.
        q: (N, n) positions [rad].
        load: Declared payload of all dwells; None for no payload.
        **columns: Additional columns of the dataset, such as a measured temperature.
    """
    still = np.zeros_like(q)
    whole = motion_of(model, np.arange(len(q), dtype=np.float64), q, still, still)
    ids = [f"dwell{k}" for k in range(len(q))]
    mounted: dict[str, Any] = {} if load is None else {"payload": load}
    return replace(
        whole,
        columns={**whole.columns, **columns},
        offsets=np.arange(len(q) + 1),
        conditions=tuple(Conditions(one, "dwell", pose=k, **mounted) for k, one in enumerate(ids)),
    )


STD_ERROR_GIVEN = (
    "exact drive gains, declared loads, kinematics and form of the model; the residual's "
    "autocorrelation within a series is accounted for"
)

STD_ERROR_LEAVES_OUT = (
    "errors of the gains (they scale a joint's parameters as a whole), loads and kinematics; "
    "friction that the model does not describe; bias by noise in the regressor and by filters, "
    "which smear reversals; effects common to all series, such as temperature; correlation "
    "between joints"
)


class WlsEstimator(RobotEstimator):
    """Base class of models whose torque is a regressor times coefficients.

    Attributes:
        parameter_names_: Names of the p coefficients.
        coefficients_: (p,) coefficients in SI units.
        std_error_: (p,) standard errors of the coefficients; the texts `STD_ERROR_GIVEN` and
            `STD_ERROR_LEAVES_OUT` state their assumptions.
        correlated_samples_: (n,) number of successive samples of a joint that count as one sample
            in `std_error_`; 1 for independent samples. The module `hil.estimators.covariance`
            describes how correlated samples are counted.
        condition_: Condition number of the weighted regressor after scaling of its columns.
    """

    parameter_names_: tuple[str, ...]
    coefficients_: FloatArray
    std_error_: FloatArray
    correlated_samples_: FloatArray
    condition_: float

    @abstractmethod
    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """Return the components of the effort without payload by name, each (N, n)."""

    @abstractmethod
    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield the row range, the regressor W (N·n, p) and the target torque (N, n) of each block.

        The blocks are in the order of time. The rows of the regressor W are sample-major: the n
        joints of a sample are adjacent.
        """

    @abstractmethod
    def _open(self) -> None:
        """Prepare the regressor for `robot_`, before a fit or after a model file has been read."""

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, without memory of earlier samples."""
        return MemorylessStream(self.robot_.n, self._parts, self._load_effort, payload or Payload())

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return coefficients, standard errors, torque scale and residual deviations as arrays."""
        return {
            "coefficients": self.coefficients_,
            "std_error": self.std_error_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Return the parameter names, condition number and assumptions of the standard errors."""
        return super().fitted_facts() | {
            "parameter_names": list(self.parameter_names_),
            "condition": self.condition_,
            "std_error": {
                "given": STD_ERROR_GIVEN,
                "leaves_out": STD_ERROR_LEAVES_OUT,
                "correlated_samples": self.correlated_samples_,
            },
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        self._restore_common(arrays, facts)
        self._open()
        self.coefficients_, self.std_error_ = arrays["coefficients"], arrays["std_error"]
        self.parameter_names_ = tuple(facts["parameter_names"])
        if not len(self.coefficients_) == len(self.std_error_) == len(self.parameter_names_):
            raise ValueError(
                f"coefficients: {len(self.coefficients_)} for {len(self.parameter_names_)} names"
            )
        self.condition_ = float(facts["condition"])
        # Older versions of hil treated every sample as independent and did not store the count.
        counted = facts.get("std_error", {}).get("correlated_samples", [1.0] * len(self.sigma_))
        self.correlated_samples_ = np.array(counted, dtype=np.float64)

    def _solve(self, data: Dataset, *, weighted: bool) -> None:
        """Solve the least-squares problem of the observed torques; set the fitted attributes."""
        self._adopt(data, jointwise_least_squares(self._compressed(data), weighted=weighted))

    def _compressed(self, data: Dataset) -> JointwiseQR:
        """Return all observations, reduced to one triangular factor per joint."""
        observed = JointwiseQR(data.n_joints)
        for _, W, target in self._observations(data):
            observed.add(W, target)
        return observed

    def _adopt(self, data: Dataset, solution: Solution) -> None:
        """Set the fitted attributes from a least-squares solution."""
        require_rank(solution.rank, solution.condition, self.parameter_names_, solution.system[0])
        self.coefficients_, self.condition_ = solution.coefficients, solution.condition
        self.sigma_ = solution.sigma / self.torque_scale_
        self._set_uncertainty(data, solution)

    def _set_uncertainty(self, data: Dataset, solution: Solution) -> None:
        """Set the attributes `correlated_samples_` and `std_error_`."""
        residual = self._residual(data, solution.coefficients)
        self.correlated_samples_ = correlated_samples(residual, data.offsets)
        # The covariance is (XᵀWX)⁻¹ XᵀW·V·WX (XᵀWX)⁻¹, with V the variance of a joint times its
        # correlation time in samples.
        X, _, joint = solution.system
        deviation = solution.sigma * np.sqrt(self.correlated_samples_)
        score = X * (solution.weight * deviation)[joint, None]
        self.std_error_ = np.linalg.norm(score @ solution.bread, axis=0)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        """Return (N, n) the target torque minus the product of regressor and coefficients (p,)."""
        residual = np.empty_like(data["q"])
        for rows, W, target in self._observations(data):
            residual[rows] = target - (W @ coefficients).reshape(target.shape)
        return residual

    def _predict(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> Prediction:
        parts = self._all_parts(dataset, q, qd, qdd)
        load = payload_torque(self.robot_, dataset, q, qd, qdd) / self.torque_scale_
        effort: FloatArray = np.sum([*parts.values(), load], axis=0)
        std = np.broadcast_to(self.sigma_, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), {**parts, "payload": load})

    def _all_parts(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        pieces = [self._parts(q[rows], qd[rows], qdd[rows]) for rows in chunks(dataset)]
        names = pieces[0] if pieces else ()
        return {name: np.concatenate([part[name] for part in pieces]) for name in names}

    def _load_effort(
        self, load: Payload, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        effort: FloatArray = self.robot_.payload_effort(load, q, qd, qdd) / self.torque_scale_
        return effort
