"""Base class of studies, progress callbacks, and the lookup of a study by name."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

from hil.core import SpecError, plugins
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import Needs, Parametrised, choice, require_known
from hil.studies.result import StudyResult

GROUP = "hil.studies"

Progress: TypeAlias = Callable[[str, int, int], None]
"""Progress callback `(step, done, total)`: name of the current step, number of completed parts, and
total number of parts.
"""


def silent(what: str, done: int, total: int) -> None:
    """Ignore a progress update."""


@dataclass(frozen=True, slots=True)
class Ended:
    """Progress report on one completed fit of a study.

    Attributes:
        number: Number of fits completed so far, including this one.
        total: Total number of fits.
        name: Display name of the fit.
        seconds: Duration of this fit alone, without other fits [s].
        failed: `failed`, or a text that lists the failed parts of the fit; empty if the fit
            succeeded.
    """

    number: int
    total: int
    name: str
    seconds: float
    failed: str = ""


def tell_ended(progress: Progress, ended: Ended) -> None:
    """Pass a completed fit to the method `ended` of a progress callback, if this method exists."""
    if (listener := getattr(progress, "ended", None)) is not None:
        listener(ended)


class Study(Parametrised):
    """Evaluation of a whole run, with parameters in the scikit-learn style (`Parametrised`).

    Attributes:
        study: Name under which the study is registered.
    """

    study: ClassVar[str] = ""

    def extras(self) -> Mapping[str, str]:
        """Return the optional dependencies (extras) that the study requires, each with its purpose.

        The extras of a study are checked before any motion.
        """
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the data that the method `run` requires.

        A run is rejected before any motion if it cannot provide the required data.

        Args:
            robot: Model of the arm.
            loaded: Whether a payload is mounted in any part of the run.
        """
        return Needs()

    @abstractmethod
    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Evaluate a run; equal data and equal parameters give equal numbers.

        Args:
            dataset: Data of the whole run, including moves between the motions.
            robot: Model of the arm that the run was recorded on.
            progress: Progress callback.

        Raises:
            FitError, DataError: The data of the run are not sufficient or not suitable.
        """


def study(name: str, /, **params: Any) -> Study:
    """Create a study by the name under which it is registered in `hil.studies`.

    Raises:
        PluginError: No study is registered under this name, or its plug-in cannot be loaded.
        SpecError: The study does not have one of the passed parameters, or rejects the value of a
            parameter.
    """
    kind = plugins.load(GROUP, name)
    require_known(params, kind.parameter_names(), name)
    try:
        made: Study = kind(**params)
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    except (ValueError, TypeError) as error:
        raise SpecError(f"{name}: {error}") from error
    return made


def subset(name: str, given: Any, known: Sequence[str]) -> list[str]:
    """Return the selected names in the order of `known`, without duplicates.

    Raises:
        SpecError: The value is not a list, is empty, or contains an unknown name.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of {', '.join(known)}")
    chosen = {choice(name, word, known) for word in given}
    return [word for word in known if word in chosen]
