"""Models of the robots of a fleet: one fit per run, stored and registered by robot name.

Fits run in processes of this computer or on a Dask cluster; the two give bit-identical results
(`fit_runs`). A worker that has access to the run directory reads the run there; other workers
receive the samples (`RunToSend`). If the fit of one robot fails or its process dies, the
`FitResult` of this robot contains the reason, and the other robots are still fitted. `store_fits`
stores the models, and `register_fit` registers one model.
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
    """Estimator and parameters that are used for the fit of each run.

    Attributes:
        estimator: Name of the estimator in `hil.estimators`.
        parameters: Parameters of the estimator.
    """

    estimator: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


Progress = Callable[[int], object]
"""Callback that receives the number of finished tasks."""


def fit_runs(
    runs: Sequence[Path],
    settings: FitSettings,
    *,
    workers: int,
    dask: str | None = None,
    on_progress: Progress = lambda done: None,
) -> list[FitResult]:
    """Fit a model to each run separately; return the results in the order of the runs.

    Args:
        runs: Run directories.
        settings: Estimator that is fitted, with its parameters.
        workers: Number of processes of this computer that fit models.
        dask: Address of a Dask scheduler whose workers are used instead of local processes.
        on_progress: Callback that receives the number of finished fits.

    Raises:
        FitError: Workers of the cluster died repeatedly, or no worker is left.
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
        # None: the worker has no access to that run and must receive the samples.
        unseen = [i for i, result in enumerate(results) if result is None]
        sent = computed([RunToSend(paths[i], settings) for i in unseen], len(runs) - len(unseen))
        for i, result in zip(unseen, sent, strict=True):
            results[i] = result
    return [result for result in results if result is not None]


DIED = f"its process died {TRIES} times, the last time alone: probably out of memory"


def _task(run: Path, settings: FitSettings) -> Callable[[], FitResult | None]:
    try:
        return partial(fit_at, run, identity(run)[0], settings)
    except DataError as error:  # the run was deleted: continue with the others
        return partial(FitResult, error=error.message)


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """Result of one fit of a run.

    Attributes:
        folder: Name of the model's folder, `<estimator>-<digest>`.
        files: Content of the model's files by file name; empty if there is no model.
        rmse: (n,) raw RMSE of the model on the hold-out set.
        passed: Flag; true if the model meets all model criteria in the run's spec. `passed` is None
            if there are no criteria, if the criteria do not apply to such a model, or if some
            criteria concern loads, which only a run can check.
        error: Reason why there is no model; empty if there is a model.
    """

    folder: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    rmse: tuple[float, ...] = ()
    passed: bool | None = None
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class RunSplit:
    """Data and criteria of a run, as used in a fit.

    Attributes:
        parts: Training data and hold-out set, divided as defined in the run's spec.
        serial: Serial number of the robot of the run.
        accept: Acceptance criteria in the run's spec.
    """

    parts: Parts
    serial: str
    accept: Accept


def split_of(run: Path, settings: FitSettings) -> RunSplit:
    """Return the training data and the hold-out set of a run.

    Raises:
        DataError: The run cannot be read, or no hold-out set is possible.
        FitError: The run contains no data that are usable for the estimator.
        SpecError: The spec of the run cannot be read.
    """
    data = usable_part(load_source(run), make_estimator(settings.estimator, **settings.parameters))
    spec = load_spec(run / "spec.yaml", look_up=False)
    return RunSplit(hold_out(data, spec.hold_out), serial_of(run), spec.accept)


def fit_split(split: RunSplit, settings: FitSettings) -> FitResult:
    """Fit a model, check it on the hold-out set, and return the result with the model's files.

    Raises:
        FitError: The data of the run are not sufficient for the fit.
        PluginError, SpecError: The estimator, one of its parameters, or the robot does not exist.
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
    """Return the fit of the run at a path, or None if the expected run is not at this path.

    Args:
        run: Run directory.
        uid: Identity of the expected run. On a different computer, the path may contain a run with
            a different identity.
        settings: Estimator that is fitted, with its parameters.
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
    # Estimators are plug-ins: any exception must affect only the robot of this model.
    except Exception as error:
        return FitResult(error=f"the fit failed: {type(error).__name__}: {error}")


@dataclass(frozen=True, slots=True)
class RunToSend:
    """Fit task for a worker process without access to the run directory.

    The samples of the run are read when the task is pickled.

    Attributes:
        run: Run directory on this computer.
        settings: Estimator that is fitted, with its parameters.
    """

    run: Path
    settings: FitSettings

    def __call__(self) -> FitResult:
        """Fit the run in this process and return the result."""
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
    """Fit of the model of one robot of a fleet.

    Attributes:
        robot: Name of the robot.
        run: Run with the training data.
        result: Result of the robot's fit.
        model: Folder of the stored model; None if there is no model.
        registered: Version of the model in the registry, such as `v3`; empty if the model was not
            registered.
        role: Role of the version in the registry, `champion` or `challenger`; empty for neither.
        verdict: Verdict on the run: `passed`, `rejected` or `not judged`.
        refused: Reason why the registration was refused; empty if it was not refused.
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
        """Reason why there is no model or why its registration was refused; empty for a success."""
        return self.result.error or self.refused

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of this robot in `hil fleet fit --json`."""
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
    """Return the name of a run's robot in its station; for a deleted run, from its folder."""
    try:
        return str(read_json(run / "start.json")["robot_name"])
    except (DataError, KeyError):
        return run.parent.name


def store_fits(runs: Sequence[Path], results: Sequence[FitResult], out: Path) -> list[RobotFit]:
    """Store the models of a fleet as `out/ROBOT/<estimator>-<digest>`.

    Identical files are not written again, except `model.json`, which always gets the current time.
    The time in `model.json` is needed because the model that was stored last counts as the robot's
    model (`survey_fleet`).

    Raises:
        OSError: The models cannot be written.
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
        with contextlib.suppress(OSError):  # the file may belong to a different user
            os.utime(folder / "model.json")
        fits.append(RobotFit(robot, run, result, folder, verdict=verdict))
    return fits


def register_fit(fit: RobotFit, registry: Registry) -> RobotFit:
    """Register a model under the name of its robot, usually as challenger.

    A model becomes champion if it meets the criteria of its run and there is no champion yet. A
    model gets no role if it misses the criteria or belongs to a rejected run. A model that was not
    judged against criteria becomes challenger at most. The registration is refused if the models of
    that name belong to a robot with a different serial number.

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
    """Return a message if a model and the models of a name have different robots; else empty."""
    if not serial or name not in registry.names():
        return ""
    versions, champion = registry.versions(name), registry.aliases(name).champion
    known = next((each for each in versions if each.number == champion), versions[-1])
    theirs = str(known.facts.get("serial", ""))
    if theirs in ("", serial):
        return ""
    return (
        f"{known.label} of {name} in {registry.root} belongs to serial number {theirs}, this robot "
        f"has {serial}; give each robot a name that no other station uses, or use another registry"
    )
