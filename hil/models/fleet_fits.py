"""Models of the robots of a fleet: one fit per run, stored and registered under the robots' names.

Fits are computed by processes of this computer or by a Dask cluster, equal to the bit wherever they
are computed (`fit_runs`). A worker that sees the run directory reads it itself; to one that does
not, the samples are sent (`RunToSend`). If one robot's fit fails or its process dies, its
`FitResult` says why, and the others are fitted. `store_fits` stores the models, `register_fit`
registers one.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from hil.core import (
    TRIES,
    DataError,
    HilError,
    cluster,
    json_document,
    read_json,
    spread,
    spread_over_processes,
    write_whole,
)
from hil.dynamics import load_model
from hil.estimators import estimator as make_estimator
from hil.evaluation import (
    EVALUATION_FILE,
    Parts,
    VerdictWord,
    fit_dataset,
    hold_out,
    judged_model,
    usable_part,
    verdict_word,
)
from hil.importers import load_source, serial_of
from hil.models.drift import identity
from hil.models.model_registry import Registry, facts_of
from hil.spec import Accept, load_spec


@dataclass(frozen=True, slots=True)
class FitSettings:
    """What is fitted to each run.

    Attributes:
        estimator: Name in `hil.estimators`.
        parameters: Parameters of the estimator.
    """

    estimator: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


Progress = Callable[[int], object]
"""Called with the number of tasks that are done."""


def fit_runs(
    runs: Sequence[Path],
    settings: FitSettings,
    *,
    workers: int,
    dask: str | None = None,
    on_progress: Progress = lambda done: None,
) -> list[FitResult]:
    """Fit every run by itself; return the results in the order of the runs.

    Args:
        runs: Run directories.
        settings: What to fit.
        workers: Number of processes of this computer.
        dask: Address of a Dask scheduler; its workers are used instead of local processes.
        on_progress: Called with the number of fits that are done.

    Raises:
        FitError: Workers of the cluster died again and again, or none is left.
        PluginError: Dask is not installed.
    """
    paths = [run.resolve() for run in runs]
    tasks = [_task(run, settings) for run in paths]
    with cluster(dask) as executor:

        def computed(
            tasks: Sequence[Callable[[], FitResult | None]], before: int
        ) -> list[FitResult | None]:
            def count(results: Mapping[int, FitResult | None]) -> None:
                on_progress(before + sum(one is not None for one in results.values()))

            if executor is not None:
                return spread(tasks, [1.0] * len(tasks), executor, count)
            return spread_over_processes(tasks, workers, count, lambda i: FitResult(error=DIED))

        results = computed(tasks, 0)
        # None: the worker does not see that run, so it gets the samples.
        unseen = [i for i, result in enumerate(results) if result is None]
        sent = computed([RunToSend(paths[i], settings) for i in unseen], len(runs) - len(unseen))
        for i, result in zip(unseen, sent, strict=True):
            results[i] = result
    return [result for result in results if result is not None]


DIED = f"its process died {TRIES} times, the last time alone: probably out of memory"


def _task(run: Path, settings: FitSettings) -> Callable[[], FitResult | None]:
    try:
        return partial(fit_at, run, identity(run)[0], settings)
    except DataError as error:  # the run was deleted meanwhile: the others are still there
        return partial(FitResult, error=error.message)


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """The result of one fit.

    Attributes:
        folder: Name of the model's folder, `<estimator>-<digest>`.
        files: Its content, by name; empty if there is no model.
        rmse: (n,) raw RMSE on what was held out.
        passed: Whether the model meets all criteria for models in the run's spec; None if there are
            none, if they do not apply to such a model, or if some are about loads, which only a run
            judges.
        error: Why there is no model.
    """

    folder: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    rmse: tuple[float, ...] = ()
    passed: bool | None = None
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class RunSplit:
    """What a fit needs of a run.

    Attributes:
        parts: To fit to and to judge on, as the run's spec says.
        serial: Serial number of the robot.
        accept: Criteria of the run's spec.
    """

    parts: Parts
    serial: str
    accept: Accept


def split_of(run: Path, settings: FitSettings) -> RunSplit:
    """Return the part of a run to fit to and the part that is held out.

    Raises:
        DataError: The run cannot be read, or nothing can be held out.
        FitError: It has nothing the estimator works on.
        SpecError: Its spec cannot be read.
    """
    data = usable_part(load_source(run), make_estimator(settings.estimator, **settings.parameters))
    spec = load_spec(run / "spec.yaml", look_up=False)
    return RunSplit(hold_out(data, spec.hold_out), serial_of(run), spec.accept)


def fit_split(split: RunSplit, settings: FitSettings) -> FitResult:
    """Fit and judge; return the result with the model's files.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator, parameter or robot.
    """
    train = split.parts.train
    robot = load_model(train.robot, gravity=train.gravity)
    with tempfile.TemporaryDirectory(prefix="hil-fit-") as folder:
        fitted = fit_dataset(
            train,
            settings.estimator,
            robot,
            out=Path(folder),
            serial=split.serial,
            **settings.parameters,
        )
        files = {path.name: path.read_bytes() for path in sorted(fitted.folder.iterdir())}
    judged = judged_model(settings.estimator, fitted, split.parts, split.accept)
    verdict = judged.verdict
    passed = verdict.passed if verdict.judged else None
    return FitResult(
        fitted.folder.name,
        files | {EVALUATION_FILE: json_document(judged.document)},
        tuple(map(float, judged.held_out.total.rmse_raw)),
        None if passed and split.accept.under_loads else passed,
    )


def fit_at(run: Path, uid: str, settings: FitSettings) -> FitResult | None:
    """Fit a run by its path; return None if that run is not there, as on another computer.

    Args:
        run: Its directory.
        uid: Its identity: on another computer another run may have this path.
        settings: What to fit.
    """
    try:
        seen = identity(run)[0] == uid
    except HilError:
        seen = False
    return _fit_or_error(lambda: fit_split(split_of(run, settings), settings)) if seen else None


def _fit_or_error(fit: Callable[[], FitResult]) -> FitResult:
    try:
        return fit()
    except HilError as error:
        return FitResult(error=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the other robots.
    except Exception as error:
        return FitResult(error=f"it broke down: {type(error).__name__}: {error}")


@dataclass(frozen=True, slots=True)
class RunToSend:
    """Fit task for a worker without access to the run directory.

    The samples are read when it is pickled.

    Attributes:
        run: Its directory, here.
        settings: What to fit.
    """

    run: Path
    settings: FitSettings

    def __call__(self) -> FitResult:
        """Fit the run in this process."""
        return _fit_or_error(lambda: fit_split(split_of(self.run, self.settings), self.settings))

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            return partial, (_fit_sent, split_of(self.run, self.settings), self.settings)
        except HilError as error:
            return partial, (FitResult, "", {}, (), None, error.message)


def _fit_sent(split: RunSplit, settings: FitSettings) -> FitResult:
    return _fit_or_error(lambda: fit_split(split, settings))


@dataclass(frozen=True, slots=True)
class RobotFit:
    """The fit of one robot.

    Attributes:
        robot: Its name.
        run: Run that was fitted to.
        result: Of the fit.
        model: Folder of the model; None without one.
        registered: Version in the registry, such as `v3`; empty if it was not registered.
        role: `champion` or `challenger`; empty if it is neither.
        verdict: On the run: `passed`, `rejected` or `not judged`.
        refused: Why it was not registered; empty if it was, or was not to be.
    """

    robot: str
    run: Path
    result: FitResult
    model: Path | None = None
    registered: str = ""
    role: str = ""
    verdict: VerdictWord = "not judged"
    refused: str = ""

    @property
    def error(self) -> str:
        """Why there is no model, or why it was not registered; else empty."""
        return self.result.error or self.refused

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `hil fleet fit --json`."""
        return {
            "robot": self.robot,
            "run": str(self.run),
            "model": self.model and str(self.model),
            "rmse_raw": list(self.result.rmse),
            "passed": self.result.passed,
            "verdict": self.verdict,
            "registered": self.registered or None,
            "role": self.role or None,
            "error": self.error or None,
        }


def robot_of(run: Path) -> str:
    """Return the name of a run's robot in its station; of a deleted run that of its folder."""
    try:
        return str(read_json(run / "start.json")["robot_name"])
    except (DataError, KeyError):
        return run.parent.name


def store_fits(runs: Sequence[Path], results: Sequence[FitResult], out: Path) -> list[RobotFit]:
    """Store models as `out/ROBOT/<estimator>-<digest>`.

    Equal files are not written again, but `model.json` gets the present time in any case: the model
    stored last counts as the robot's (`survey_fleet`).

    Raises:
        OSError: They cannot be written.
    """
    fits = []
    for run, result in zip(runs, results, strict=True):
        robot, verdict = robot_of(run), verdict_word(run)
        if not result.files:
            fits.append(RobotFit(robot, run, result, verdict=verdict))
            continue
        folder = out / robot / result.folder
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in result.files.items():
            if not (folder / name).exists() or (folder / name).read_bytes() != content:
                write_whole(folder / name, content)
        with contextlib.suppress(OSError):  # a model of somebody else: it is as good as it was
            os.utime(folder / "model.json")
        fits.append(RobotFit(robot, run, result, folder, verdict=verdict))
    return fits


def register_fit(fit: RobotFit, registry: Registry) -> RobotFit:
    """Register a model under its robot's name, as challenger; a first good one becomes champion.

    A good model meets its run's criteria. One that misses them, or is of a run that was rejected,
    becomes neither; one that was not judged becomes challenger at most. A model of another
    individual than the name's is refused.

    Raises:
        RegistryError: The registry cannot be written.
    """
    if fit.model is None:
        return fit
    facts = facts_of(fit.model, [fit.run])
    if refused := _serial_conflict(fit.robot, facts["serial"], registry):
        return replace(fit, refused=refused)
    rejected = fit.result.passed is False or fit.verdict == "rejected"
    version = registry.register(fit.robot, fit.model, facts, challenger=not rejected)
    now = registry.aliases(fit.robot)
    if fit.result.passed and not rejected and not now.champion:
        evidence = {"evaluation": facts["evaluation"]}
        now = registry.promote(
            fit.robot, version.number, reason="the first model of its robot", evidence=evidence,
            instead_of=0,
        )  # fmt: skip
    role = {now.champion: "champion", now.challenger: "challenger"}.get(version.number, "")
    return replace(fit, registered=version.label, role=role)


def _serial_conflict(name: str, serial: str, registry: Registry) -> str:
    """Return why a model is not of the robot of a name; empty if it is, or if that is unknown."""
    if not serial or name not in registry.names():
        return ""
    versions, champion = registry.versions(name), registry.aliases(name).champion
    known = next((each for each in versions if each.number == champion), versions[-1])
    theirs = str(known.facts.get("serial", ""))
    if theirs in ("", serial):
        return ""
    return (
        f"{known.label} of {name} in {registry.root} is of serial {theirs}, this robot is "
        f"{serial}; give robots names that no other station has, or use another registry"
    )
