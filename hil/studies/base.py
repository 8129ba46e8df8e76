"""What every study shares, and how one is found by name."""

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
"""Told what is being done, and how many of how many steps of that are done."""


def silent(what: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A fit of a study that is done.

    Attributes:
        number: How many are done with it.
        total: How many there are.
        name: What was fitted, for people.
        seconds: How long it took by itself [s].
        failed: `failed`, or what of it did, in words; empty when nothing did.
    """

    number: int
    total: int
    name: str
    seconds: float
    failed: str = ""


def tell_ended(progress: Progress, ended: Ended) -> None:
    """Tell a fit that is done to a progress that has a method `ended`; others do not hear of it."""
    if (listener := getattr(progress, "ended", None)) is not None:
        listener(ended)


class Study(Parametrised):
    """An evaluation of a whole run; parameters the scikit-learn way (`Parametrised`).

    Attributes:
        study: Name under which the class is registered.
    """

    study: ClassVar[str] = ""

    def extras(self) -> Mapping[str, str]:
        """Extras of this distribution that it needs, and what for; asked before any motion."""
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what `run` cannot do without; a run is refused before it moves if it is missing.

        Args:
            robot: Model of the arm.
            loaded: Whether a load is mounted in any part of the run.
        """
        return Needs()

    @abstractmethod
    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Everything the study finds in a run; equal data and parameters give equal numbers.

        Args:
            dataset: The whole run, moves included.
            robot: Model of the arm it was recorded on.
            progress: Told how far it is.

        Raises:
            FitError, DataError: The run does not allow it.
        """


def study(name: str, /, **params: Any) -> Study:
    """A fresh study by the name it is registered under in `hil.studies`.

    Raises:
        PluginError: There is no study of that name, or it does not load.
        SpecError: It has no such parameter, or does not accept the value.
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
    """Some of the known words, in the order of those.

    Raises:
        SpecError: It is no list, is empty, or holds another word.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of {', '.join(known)}")
    chosen = {choice(name, word, known) for word in given}
    return [word for word in known if word in chosen]
