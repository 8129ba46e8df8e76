"""What every estimator of a robot model shares: its life, its parameters and its file.

An estimator is made by name (`estimator`), fitted to a `Dataset` (`fit`) and from then on *is* the
model: it predicts recordings (`predict`) and single samples (`stream`), and is written to a folder
(`save`) and read from one (`load_model_file`). `RobotEstimator` says what that takes, in the style
of scikit-learn: parameters are declared (`hil.estimators.parameters`), fitted attributes end in
`_`. `WlsEstimator` is the base of all models whose torque is a regressor times coefficients; it
leaves the regressor to its subclasses.
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
"""Protocol of a model that predicts from the motion and the load alone."""


class RobotEstimator(Parametrised):
    """Fits a model of one robot to a `Dataset` and then *is* that model.

    Attributes:
        estimator: Name under which the class is registered.
        series_kinds: Which series it learns from, the preferred kinds first.
        tells_friction: Whether its predictions say which part of them is friction.
        robot_: The robot model it was fitted for.
        joint_names_: Joints, in the order of every array.
        effort_kind_: `current` or `torque`, the unit of predictions.
        torque_scale_: (n,) torque per unit of effort; 1 when the effort is a torque.
        gains_source_: Where the drive gains come from; empty without.
        sigma_: (n,) standard deviation of the training residual, in effort units.
        samples_: Rows (or dwells) the fit used.
        training_: What the model remembers of its training data; None in older model files.
        notes_: What a fit did about data that are not as they should be, for people.
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
        """`honest`, or how the model departs from that to reproduce a publication.

        It is shown beside the model's name, and only honest models are judged against criteria.
        """
        return HONEST

    @property
    def knows_gains(self) -> bool:
        """Whether its efforts can be stated in N·m: gains of 1 without a source stand for none."""
        without = not self.gains_source_ and bool(np.all(self.torque_scale_ == 1.0))
        return self.effort_kind_ == "torque" or not without

    def extras(self) -> Mapping[str, str]:
        """Extras of this distribution that a fit needs, and what for; checked before any motion."""
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without; `fit` requires it, and a run is refused before it.

        An estimator that states nothing is not refused before a run.

        Args:
            robot: What would be fitted.
            loaded: Whether a load is mounted in any of the data.

        Raises:
            FitError: No data of this robot can be fitted.
        """
        return Needs()

    @abstractmethod
    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to a dataset."""

    @abstractmethod
    def predict(self, dataset: Dataset) -> Prediction:
        """Predict every row."""

    @abstractmethod
    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time under a declared load."""

    @abstractmethod
    def fitted_arrays(self) -> dict[str, FloatArray]:
        """The fitted numbers, for the model file."""

    @abstractmethod
    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Inverse of `fitted_arrays` and `fitted_facts`; `robot_` is already set."""

    def fitted_facts(self) -> dict[str, Any]:
        """Names and units of what was fitted, as JSON."""
        return {
            "joint_names": list(self.joint_names_),
            "effort_kind": self.effort_kind_,
            "gains_source": self.gains_source_,
            "samples": self.samples_,
            "protocol": self.protocol,
        } | ({"notes": list(self.notes_)} if self.notes_ else {})

    def save(self, folder: Path) -> Path:
        """Write `model.json` and `model.safetensors` into a folder; returns the folder."""
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
        """Refuse to predict for another robot or unit than the model was fitted for.

        Raises:
            FitError: It is not fitted yet.
            DataError: The data are of another robot, unit or gravity; those that do not say
                their robot pass.
        """
        if not hasattr(self, "sigma_"):
            raise FitError(f"{self.estimator} is not fitted yet", hint="call fit first")
        if not may_be(dataset.robot, self.robot_):
            raise DataError(
                f"the model is of a {self.robot_.name}, the data are of a {dataset.robot}",
                hint="use a model that was fitted to recordings of the same type of robot",
            )
        if dataset.joint_names != self.joint_names_:
            raise DataError(
                f"the model is for the joints {', '.join(self.joint_names_)}, "
                f"the data have {', '.join(dataset.joint_names)}",
                hint="take recordings of the robot that the model is for",
            )
        if dataset.effort_kind != self.effort_kind_:
            raise DataError(
                f"the model predicts a {self.effort_kind_}, the data hold a {dataset.effort_kind}",
                hint="fit and judge on recordings of the same quantity",
            )
        if not np.allclose(dataset.gravity, self.robot_.gravity_vector, atol=0.05):
            raise DataError(
                f"the model is for gravity {self.robot_.gravity_vector.tolist()} in the base "
                f"frame, the data were recorded under {list(dataset.gravity)} m/s²",
                hint="a model of an arm mounted differently needs a fit of its own",
            )


def estimator(name: str, /, **params: Any) -> RobotEstimator:
    """A fresh estimator by the name it is registered under in `hil.estimators`.

    Raises:
        PluginError: There is no estimator of that name, or it does not load.
        SpecError: It has no such parameter, or does not accept the value.
    """
    kind = plugins.load(GROUP, name)
    require_known(params, kind.parameter_names(), name)
    try:
        made: RobotEstimator = kind(**params)
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    except (ValidationError, ValueError, TypeError) as error:
        # A plug-in that does not check its parameters as `hil.estimators.parameters` would.
        raise SpecError(f"{name}: {_first_line(error)}") from error
    return made


def _first_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where}: {first['msg']}"
    return str(error)


def load_model_file(folder: str | Path) -> RobotEstimator:
    """The model a folder holds, ready to predict.

    Args:
        folder: Of the model, or a run with just one.

    Raises:
        DataError: Files are missing or damaged, were written by a newer hil, or the run has
            several models.
        PluginError: The estimator it was made with is not installed.
    """
    folder = only_model(Path(folder))
    document = read_document(folder / MODEL_FILE)
    arrays = read_arrays(folder / ARRAYS_FILE, str(document.get("arrays_sha256", "")))
    try:
        model = estimator(_text(document["estimator"]), **document["parameters"])
        model.robot_ = restore_robot(document["robot"], folder)
        model.restore(arrays, document["fitted"])
        require_sound(model)
        # Models of an older hil do not say what they were trained on.
        if document.get("training"):
            model.training_ = Training.restored(document["training"], arrays)
    except _GARBLED as error:
        raise DataError(
            f"{folder / MODEL_FILE} lacks or garbles {error}", hint="fit the model again"
        ) from error
    return model


_GARBLED = (
    KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, MemoryError,
    SpecError,
)  # fmt: skip
"""What reading a damaged document may end with; estimators are plug-ins and check little."""

PREDICTING = frozenset({"coefficients", "rigid", "gear_rigid", "friction", "inertial", "exponent"})
"""Arrays of models that predictions come from: never without a number."""


def require_sound(model: RobotEstimator) -> None:
    """Refuse names and units that are none before a prediction stumbles over them.

    Raises:
        TypeError, ValueError: Something fitted cannot be; the message names it.
    """
    names = [_text(name) for name in model.joint_names_]
    if not np.shape(model.sigma_) == np.shape(model.torque_scale_) == (len(names),):
        raise ValueError(f"joint_names: {len(names)} for {np.size(model.sigma_)} joints")
    if not (np.all(np.isfinite(model.torque_scale_)) and np.all(model.torque_scale_ > 0)):
        raise ValueError(f"torque_scale: {model.torque_scale_.tolist()!s:.60}")
    # A deviation that is not known is NaN.
    if np.any(np.isinf(model.sigma_) | (model.sigma_ < 0)):
        raise ValueError(f"sigma: {model.sigma_.tolist()!s:.60}")
    for name, values in model.fitted_arrays().items():
        if name in PREDICTING and not np.all(np.isfinite(values)):
            raise ValueError(f"{name}: it holds values that are not finite")
    if model.effort_kind_ not in ("current", "torque"):
        raise ValueError(f"effort_kind: {model.effort_kind_!r:.60}")


def _text(value: object) -> str:
    """A text as it is.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.60} is no text")
    return value


def needs_of(plug_in: Any, robot: RobotModel, *, loaded: bool = False) -> Needs:
    """Return what an estimator or study states that it needs; plug-ins need not state anything.

    Raises:
        FitError: No data of this robot will do.
    """
    stated = getattr(plug_in, "needs", None)
    needs: Needs = Needs() if stated is None else stated(robot, loaded=loaded)
    return needs


def prepared(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """The dataset with filtered columns: those it has already, or fresh ones."""
    return dataset if is_prepared(dataset) else prepare(dataset, settings)


def training_rows(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """Return the rows that a fit uses, with filtered columns; rows to judge are left out."""
    data = downsample(prepared(dataset, settings), settings)
    wanted = rows_to_fit(data)
    return data if np.all(wanted) else rows_of(data, wanted)


CHUNK = 4096
"""Samples whose regressor is built at once; bounds memory on long recordings."""

LONG = 65_536
"""Samples from which it pays to load compiled regressors, which take larger chunks."""


def chunks(dataset: Dataset) -> Iterator[slice]:
    """Row ranges of bounded length, in order."""
    size = CHUNK if len(dataset) < LONG else max(CHUNK, COMPILED_FROM)
    for start in range(0, len(dataset), size):
        yield slice(start, min(start + size, len(dataset)))


def payload_torque(
    robot: RobotModel, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> FloatArray:
    """(N, n) torque of each series' load: the identified one where there is one, else declared."""
    torque = np.zeros_like(q)
    for condition, rows in dataset.slices():
        load = load_of(condition)
        if not load.is_empty and rows.stop > rows.start:
            torque[rows] = robot.payload_effort(load, q[rows], qd[rows], qdd[rows])
    return torque


def load_of(condition: Conditions) -> Payload:
    """The load a series was recorded with."""
    return condition.payload_identified or condition.payload


def motion_of(
    model: RobotEstimator, t: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> Dataset:
    """One series at times (N,) with motion (N, n), filtered already, nothing mounted, no effort."""
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
    """A dwell of one row at each of the positions (N, n), with what else is measured there."""
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
    "friction of another form; bias by noise in the regressor and by filters, which smear "
    "reversals; what all series have in common, such as temperature; correlation between joints"
)


class WlsEstimator(RobotEstimator):
    """A regressor in the torque domain times coefficients.

    Attributes:
        parameter_names_: Length p.
        coefficients_: (p,) in SI.
        std_error_: (p,) standard errors, see `STD_ERROR_GIVEN` and `STD_ERROR_LEAVES_OUT`.
        correlated_samples_: (n,) how many successive samples of a joint count as one in
            `std_error_`, 1 for independent ones; see `hil.estimators.covariance`.
        condition_: Condition number of the column-scaled, weighted regressor.
    """

    parameter_names_: tuple[str, ...]
    coefficients_: FloatArray
    std_error_: FloatArray
    correlated_samples_: FloatArray
    condition_: float

    @abstractmethod
    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """Named parts of the effort without payload, each (N, n)."""

    @abstractmethod
    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Rows of the data, W (N·n, p) sample-major and the target torque (N, n), in order."""

    @abstractmethod
    def _open(self) -> None:
        """Set up the regressor for `robot_`; also called when a model file is read."""

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time; it has no memory, so samples stand alone."""
        return MemorylessStream(self.robot_.n, self._parts, self._load_effort, payload or Payload())

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Coefficients, their errors, gains and residual deviations."""
        return {
            "coefficients": self.coefficients_,
            "std_error": self.std_error_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Parameter names, how well they were excited, and what their errors mean."""
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
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        self._restore_common(arrays, facts)
        self._open()
        self.coefficients_, self.std_error_ = arrays["coefficients"], arrays["std_error"]
        self.parameter_names_ = tuple(facts["parameter_names"])
        if not len(self.coefficients_) == len(self.std_error_) == len(self.parameter_names_):
            raise ValueError(
                f"coefficients: {len(self.coefficients_)} for {len(self.parameter_names_)} names"
            )
        self.condition_ = float(facts["condition"])
        # Older model files took every sample for independent.
        counted = facts.get("std_error", {}).get("correlated_samples", [1.0] * len(self.sigma_))
        self.correlated_samples_ = np.array(counted, dtype=np.float64)

    def _solve(self, data: Dataset, *, weighted: bool) -> None:
        """Fit to the observations, whose target is a torque; sets the fitted attributes."""
        self._adopt(data, jointwise_least_squares(self._compressed(data), weighted=weighted))

    def _compressed(self, data: Dataset) -> JointwiseQR:
        """All observations, one triangle per joint."""
        observed = JointwiseQR(data.n_joints)
        for _, W, target in self._observations(data):
            observed.add(W, target)
        return observed

    def _adopt(self, data: Dataset, solution: Solution) -> None:
        """Take over a solution; sets the fitted attributes."""
        require_rank(solution.rank, solution.condition, self.parameter_names_, solution.system[0])
        self.coefficients_, self.condition_ = solution.coefficients, solution.condition
        self.sigma_ = solution.sigma / self.torque_scale_
        self._set_uncertainty(data, solution)

    def _set_uncertainty(self, data: Dataset, solution: Solution) -> None:
        """Set `correlated_samples_` and `std_error_`."""
        residual = self._residual(data, solution.coefficients)
        self.correlated_samples_ = correlated_samples(residual, data.offsets)
        # (XᵀWX)⁻¹ XᵀW·V·WX (XᵀWX)⁻¹ with V the variance of a joint times its correlation time.
        X, _, joint = solution.system
        deviation = solution.sigma * np.sqrt(self.correlated_samples_)
        score = X * (solution.weight * deviation)[joint, None]
        self.std_error_ = np.linalg.norm(score @ solution.bread, axis=0)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        """(N, n) target less regressor times coefficients (p,)."""
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
