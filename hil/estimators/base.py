"""What every robot-level estimator shares, and how one is found by name."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
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
from hil.estimators.checks import Needs
from hil.estimators.model_writer import save_model
from hil.estimators.parameters import Parametrised, require_known
from hil.estimators.training import Training

GROUP = "hil.estimators"

HONEST = "honest"
"""Protocol of a model that predicts from the motion and the load alone."""

CHUNK = 4096
"""Samples whose regressor is built at once; bounds memory on long recordings."""

LONG = 65_536
"""Samples from which it pays to load compiled regressors, which take larger chunks."""


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

    def extras(self) -> Mapping[str, str]:
        """Extras of this distribution that a fit needs, and what for; asked before any motion."""
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
        """What the fit found, for the model file."""

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
    """The rows that a fit uses, with filtered columns: all, or every so manyth; none to judge."""
    data = downsample(prepared(dataset, settings), settings)
    wanted = rows_to_fit(data)
    return data if np.all(wanted) else rows_of(data, wanted)


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
