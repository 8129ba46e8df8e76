"""Fits of a fleet, on processes of this computer or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from hil.dask_cluster import cluster
from hil.drift.history import identity
from hil.errors import FitError
from hil.executor import processes
from hil.fleet.fit_task import FitResult, How, Sent, fit_at
from hil.identify.model_file import write_whole
from hil.record.files import read_json
from hil.registry.registry import Registry
from hil.study.spreading import TRIES, spread

Tell = Callable[[int], object]
"""Told how many are done."""


@dataclass(frozen=True, slots=True)
class RobotFit:
    """The fit of one robot.

    Attributes:
        robot: Its name.
        run: It was fitted to.
        result: What came of it.
        model: Folder of the model, None without one.
        registered: Version in the registry, such as `v3`; empty if that was not asked.
        role: `champion` or `challenger`; empty where it is neither.
    """

    robot: str
    run: Path
    result: FitResult
    model: Path | None = None
    registered: str = ""
    role: str = ""

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet fit --json`."""
        return {
            "robot": self.robot,
            "run": str(self.run),
            "model": self.model and str(self.model),
            "rmse_raw": list(self.result.rmse),
            "passed": self.result.passed,
            "registered": self.registered or None,
            "role": self.role or None,
            "error": self.result.error or None,
        }


def robot_of(run: Path) -> str:
    """The name of a run's robot in its station.

    Raises:
        DataError: It is no run.
    """
    return str(read_json(run / "start.json")["robot_name"])


def fit_runs(
    runs: Sequence[Path],
    how: How,
    *,
    workers: int,
    dask: str | None = None,
    tell: Tell = lambda done: None,
) -> list[FitResult]:
    """Fit every run by itself, in their order; equal to the bit wherever they are fitted.

    A run that cannot be fitted leaves the others alone: its result says why.

    Args:
        runs: Their directories.
        how: What to fit.
        workers: Processes of this computer.
        dask: Scheduler whose workers take their place.
        tell: Told how many are done.

    Raises:
        DataError: One of them is no run.
        FitError: Workers died again and again, or none is left.
        PluginError: Dask is not installed.
    """
    paths = [run.resolve() for run in runs]
    tasks = [partial(fit_at, run, identity(run)[0], how) for run in paths]
    with cluster(dask) as executor:
        found = computed(tasks, workers, executor, tell)
        unseen = [i for i, one in enumerate(found) if one is None]
        sent = [Sent(paths[i], how) for i in unseen]
        more = computed(sent, workers, executor, lambda done: tell(len(runs) - len(sent) + done))
        for i, one in zip(unseen, more, strict=True):
            found[i] = one
    return found


def computed(
    tasks: Sequence[Callable[[], Any]], workers: int, executor: Executor | None, tell: Tell
) -> list[Any]:
    """Results of tasks, in their order; what dies with its process is computed again.

    Args:
        tasks: Independent of each other, and able to travel to another process.
        workers: Processes of this computer.
        executor: Takes their place, and stays open.
        tell: Told how many are done.

    Raises:
        FitError: Workers died again and again.
    """
    costs = [1.0] * len(tasks)
    found: dict[int, Any] = {}

    def news(results: Mapping[int, Any]) -> None:
        tell(len(results))

    if executor is not None:
        return spread(tasks, costs, executor, news)
    for _ in range(TRIES):
        left = [i for i in range(len(tasks)) if i not in found]
        if not left:
            break
        _on_processes([tasks[i] for i in left], left, workers, found, tell)
    if len(found) < len(tasks):
        raise FitError(
            f"{TRIES} times a process died while fitting",
            hint="they may be out of memory: --workers 1 needs the least of it",
        )
    return [found[i] for i in range(len(tasks))]


def _on_processes(
    tasks: Sequence[Callable[[], Any]],
    numbers: Sequence[int],
    workers: int,
    found: dict[int, Any],
    tell: Tell,
) -> None:
    """Compute tasks until all are done or a process dies, which ends the others of its pool."""

    def keep(results: Mapping[int, Any]) -> None:
        found.update({numbers[i]: result for i, result in results.items()})
        tell(len(found))

    pool = processes(min(workers, len(tasks)))
    try:
        spread(tasks, [1.0] * len(tasks), pool, keep)
    except BrokenExecutor:
        pool.shutdown(wait=True, cancel_futures=True)
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    else:
        pool.shutdown()


def kept(runs: Sequence[Path], results: Sequence[FitResult], out: Path) -> list[RobotFit]:
    """Store models as `out/ROBOT/<estimator>-<digest>`.

    Raises:
        OSError: They cannot be written.
    """
    return [_kept(run, one, out) for run, one in zip(runs, results, strict=True)]


def _kept(run: Path, result: FitResult, out: Path) -> RobotFit:
    robot = robot_of(run)
    if not result.files:
        return RobotFit(robot, run, result)
    folder = out / robot / result.folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in result.files.items():
        if not (folder / name).exists() or (folder / name).read_bytes() != content:
            write_whole(folder / name, content)
    return RobotFit(robot, run, result, folder)


def registered(fit: RobotFit, registry: Registry) -> RobotFit:
    """Register a model under its robot's name, as challenger; a first one becomes champion.

    One that misses its run's criteria becomes neither.

    Raises:
        RegistryError: The registry cannot be written.
    """
    from hil.registry.facts import facts_of

    if fit.model is None:
        return fit
    good = fit.result.passed is not False
    facts = facts_of(fit.model, [fit.run])
    version = registry.register(fit.robot, fit.model, facts, challenger=good)
    now = registry.aliases(fit.robot)
    if good and not now.champion:
        evidence = {"evaluation": facts["evaluation"]}
        now = registry.promote(
            fit.robot, version.number, reason="the first model of its robot", evidence=evidence,
            instead_of=0,
        )  # fmt: skip
    role = {now.champion: "champion", now.challenger: "challenger"}.get(version.number, "")
    return replace(fit, registered=version.label, role=role)
