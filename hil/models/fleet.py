"""A fleet of equal arms: a fit of each, and how its robots stand to one another.

**Fits** are computed by processes of this computer or a Dask cluster, the same bits whoever
computes them and wherever (`fit_runs`), stored, and registered under the robots' names (`kept`,
`registered`).

**A survey** has drift, friction, temperature and age of every robot, and who stands out
(`survey_fleet`). A factor on friction (wear, a gearbox that fails) is a difference of logarithms,
so values are compared by their logarithm, joint by joint. Huber's regression takes out what age and
temperature explain, the median absolute deviation says how much robots differ, and a robot stands
out whose residual is larger than the largest of a whole fleet of normal ones in 99 of 100 fleets.
That limit is simulated for this very fleet: so many robots and joints, of these ages and
temperatures. It is as good as that distribution: where equals differ by heavier tails than the
normal one's, more fleets than one of a hundred have somebody standing out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import (
    TRIES,
    BoolArray,
    DataError,
    FitError,
    FloatArray,
    HilError,
    cluster,
    json_document,
    processes,
    read_json,
    spread,
    write_whole,
)
from hil.dynamics import load_model
from hil.estimators import estimator as make_estimator
from hil.estimators import load_model_file, models_below
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
from hil.models.drift import Probe, identity, probes_of
from hil.models.fleet_folder import MODELS, FleetFolder, completed
from hil.models.model_registry import Registry, facts_of
from hil.spec import Accept, load_spec, load_station


@dataclass(frozen=True, slots=True)
class How:
    """What is fitted.

    Attributes:
        estimator: Name in `hil.estimators`.
        parameters: Its own.
    """

    estimator: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


Tell = Callable[[int], object]
"""Told how many are done."""


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
        FitError: Workers died again and again, or none is left.
        PluginError: Dask is not installed.
    """
    paths = [run.resolve() for run in runs]
    tasks = [_task(run, how) for run in paths]
    with cluster(dask) as executor:
        found = computed(tasks, workers, executor, tell)
        unseen = [i for i, one in enumerate(found) if one is None]
        sent = [Sent(paths[i], how) for i in unseen]
        more = computed(sent, workers, executor, lambda done: tell(len(runs) - len(sent) + done))
        for i, one in zip(unseen, more, strict=True):
            found[i] = one
    return found


def _task(run: Path, how: How) -> Callable[[], FitResult | None]:
    try:
        return partial(fit_at, run, identity(run)[0], how)
    except DataError as error:  # deleted since: the others are still there
        return partial(FitResult, error=error.message)


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


@dataclass(frozen=True, slots=True)
class Sent:
    """A fit of a run that the worker cannot see: the samples are read when they are sent.

    Attributes:
        run: Its directory, here.
        how: What to fit.
    """

    run: Path
    how: How

    def __call__(self) -> FitResult:
        """Fit it here."""
        return _tried(lambda: fit_learnt(learnt_of(self.run, self.how), self.how))

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            return partial, (_fitted_of, learnt_of(self.run, self.how), self.how)
        except HilError as error:
            return partial, (FitResult, "", {}, (), None, error.message)


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """What a fit needs of a run.

    Attributes:
        parts: To fit to and to judge on, as the run's spec says.
        serial: Of the robot.
        accept: Criteria of the run's spec.
    """

    parts: Parts
    serial: str
    accept: Accept


def learnt_of(run: Path, how: How) -> Learnt:
    """What of a run is fitted to, and what is held out.

    Raises:
        DataError: The run cannot be read, or nothing can be held out.
        FitError: It has nothing the estimator works on.
        SpecError: Its spec cannot be read.
    """
    data = usable_part(load_source(run), make_estimator(how.estimator, **how.parameters))
    spec = load_spec(run / "spec.yaml", look_up=False)
    return Learnt(hold_out(data, spec.hold_out), serial_of(run), spec.accept)


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What came of one fit.

    Attributes:
        folder: Name of the model's folder, `<estimator>-<digest>`.
        files: Its content, by name; empty when there is no model.
        rmse: (n,) raw, on what was held out.
        passed: Whether that meets all criteria for models in the run's spec; None if it has none,
            if they do not apply to such a model, or if some are about loads: only a run judges
            those.
        error: Why there is no model.
    """

    folder: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    rmse: tuple[float, ...] = ()
    passed: bool | None = None
    error: str = ""


def fit_at(run: Path, uid: str, how: How) -> FitResult | None:
    """Fit a run by its path; None where that run is not to be found.

    Args:
        run: Its directory.
        uid: Its identity.
        how: What to fit.
    """
    try:
        seen = identity(run)[0] == uid
    except HilError:
        seen = False
    return _tried(lambda: fit_learnt(learnt_of(run, how), how)) if seen else None


def _tried(fit: Callable[[], FitResult]) -> FitResult:
    try:
        return fit()
    except HilError as error:
        return FitResult(error=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the other robots.
    except Exception as error:
        return FitResult(error=f"it broke down: {type(error).__name__}: {error}")


def _fitted_of(learnt: Learnt, how: How) -> FitResult:
    return _tried(lambda: fit_learnt(learnt, how))


def fit_learnt(learnt: Learnt, how: How) -> FitResult:
    """Fit, judge, and give the model's files.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator, parameter or robot.
    """
    train = learnt.parts.train
    robot = load_model(train.robot, gravity=train.gravity)
    with tempfile.TemporaryDirectory(prefix="hil-fit-") as folder:
        fitted = fit_dataset(
            train, how.estimator, robot, out=Path(folder), serial=learnt.serial, **how.parameters
        )
        files = {path.name: path.read_bytes() for path in sorted(fitted.folder.iterdir())}
    judged = judged_model(how.estimator, fitted, learnt.parts, learnt.accept)
    verdict = judged.verdict
    passed = verdict.passed if verdict.judged else None
    return FitResult(
        fitted.folder.name,
        files | {EVALUATION_FILE: json_document(judged.document)},
        tuple(map(float, judged.held_out.total.rmse_raw)),
        None if passed and learnt.accept.under_loads else passed,
    )


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
        verdict: On the run: `passed`, `rejected` or `not judged`.
        refused: Why the registry does not take it, else empty.
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
        """Why there is no model, or none in the registry; else empty."""
        return self.result.error or self.refused

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet fit --json`."""
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
    """The name of a run's robot in its station; of one that has gone, as its folder had it."""
    try:
        return str(read_json(run / "start.json")["robot_name"])
    except (DataError, KeyError):
        return run.parent.name


def kept(runs: Sequence[Path], results: Sequence[FitResult], out: Path) -> list[RobotFit]:
    """Store models as `out/ROBOT/<estimator>-<digest>`.

    Raises:
        OSError: They cannot be written.
    """
    return [_kept(run, one, out) for run, one in zip(runs, results, strict=True)]


def _kept(run: Path, result: FitResult, out: Path) -> RobotFit:
    robot, verdict = robot_of(run), verdict_word(run)
    if not result.files:
        return RobotFit(robot, run, result, verdict=verdict)
    folder = out / robot / result.folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in result.files.items():
        if not (folder / name).exists() or (folder / name).read_bytes() != content:
            write_whole(folder / name, content)
    return RobotFit(robot, run, result, folder, verdict=verdict)


def registered(fit: RobotFit, registry: Registry) -> RobotFit:
    """Register a model under its robot's name, as challenger; a first good one becomes champion.

    Good is what meets its run's criteria. What misses them, or is of a run that was rejected,
    becomes neither; what nobody has judged, challenger at most. A model of another individual than
    the name's is refused.

    Raises:
        RegistryError: The registry cannot be written.
    """
    if fit.model is None:
        return fit
    facts = facts_of(fit.model, [fit.run])
    if refused := _of_another(fit.robot, facts["serial"], registry):
        return replace(fit, refused=refused)
    bad = fit.result.passed is False or fit.verdict == "rejected"
    version = registry.register(fit.robot, fit.model, facts, challenger=not bad)
    now = registry.aliases(fit.robot)
    if fit.result.passed and not bad and not now.champion:
        evidence = {"evaluation": facts["evaluation"]}
        now = registry.promote(
            fit.robot, version.number, reason="the first model of its robot", evidence=evidence,
            instead_of=0,
        )  # fmt: skip
    role = {now.champion: "champion", now.challenger: "challenger"}.get(version.number, "")
    return replace(fit, registered=version.label, role=role)


def _of_another(name: str, serial: str, registry: Registry) -> str:
    """Why a model is not of the robot that a name stands for; empty if it is, or nobody knows."""
    if not serial or name not in registry.names():
        return ""
    versions, champion = registry.versions(name), registry.aliases(name).champion
    known = next((one for one in versions if one.number == champion), versions[-1])
    theirs = str(known.facts.get("serial", ""))
    if theirs in ("", serial):
        return ""
    return (
        f"{known.label} of {name} in {registry.root} is of serial {theirs}, this robot is "
        f"{serial}; give robots names that no other station has, or use another registry"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """A fleet of equal arms, and how its robots stand to one another.

    Attributes:
        name: Of the fleet.
        folder: Where it is kept.
        robots: Measured ones.
        missing: Names of the others.
        friction: In friction; None with too few robots.
        change: In friction as a share of their champions'; None with too few probes.
    """

    name: str
    folder: Path
    robots: tuple[Surveyed, ...]
    missing: tuple[str, ...]
    friction: Standing | None
    change: Standing | None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the arms; empty where nobody has a model."""
        return next((one.joint_names for one in self.robots if one.joint_names), ())

    @property
    def drifted(self) -> tuple[Surveyed, ...]:
        """Robots whose last probe under their present champion says that they have changed."""
        return tuple(one for one in self.robots if one.probe is not None and one.probe.changed)

    @property
    def false_alarms(self) -> float:
        """Robots, at most, that are expected among `drifted` if nobody has changed.

        The sum of the rates at which their last probes were judged.
        """
        return sum(one.probe.false_alarm for one in self.robots if one.probe is not None)

    def outlying(self, which: Standing | None) -> list[tuple[int, int]]:
        """(robot, joint) of what stands out in a quantity, the farthest first."""
        if which is None:
            return []
        order = np.argsort(-np.abs(np.nan_to_num(which.z)), axis=None)
        found = np.column_stack(np.unravel_index(order, which.z.shape))
        return [(int(i), int(j)) for i, j in found if which.outlying[i, j]]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil fleet report --json`."""
        return {
            "fleet": str(self.folder),
            "name": self.name,
            "family_wise": FAMILY_WISE,
            "joint_names": list(self.joint_names),
            "robots": [one.to_dict() for one in self.robots],
            "missing": list(self.missing),
            "drifted": [one.robot for one in self.drifted],
            "false_alarms": self.false_alarms,
            "friction": self._standing(self.friction),
            "change": self._standing(self.change),
        }

    def _standing(self, which: Standing | None) -> dict[str, Any] | None:
        if which is None:
            return None
        names = self.joint_names
        return {
            "limit": which.limit,
            "slopes": {
                name: {"share": which.slopes[k].tolist(), "std": which.errors[k].tolist()}
                for k, name in enumerate(which.names)
            },
            "outliers": [
                {"robot": self.robots[i].robot, "joint": names[j], "z": float(which.z[i, j])}
                for i, j in self.outlying(which)
            ],
        }


def survey_fleet(path: Path, registry: Registry, *, workers: int) -> Survey:
    """Look at every robot of a fleet that has been measured.

    Args:
        path: Folder of the fleet.
        registry: With the robots' probes; may be empty.
        workers: Processes.

    Raises:
        DataError: It is no fleet, nothing was measured, or its robots are different arms.
        FitError: Processes died again and again.
    """
    folder, members = FleetFolder.open(path)
    runs = completed(members)
    if not runs:
        raise DataError(
            f"no robot of {folder.path} has been measured", hint=f"hil fleet resume {folder.path}"
        )
    tasks = [partial(surveyed, run, _model_of(folder, run)) for run in runs]
    known = set(registry.names())
    found: list[Surveyed] = computed(tasks, workers, None, lambda done: None)
    robots = [_probed(one, registry) if one.robot in known else one for one in found]
    if len({one.joint_names for one in robots if one.joint_names}) > 1:
        raise DataError(
            f"the robots of {folder.path} are different arms",
            hint="run a fleet of each: their friction cannot be compared",
        )
    n = max(len(one.joint_names) for one in robots)
    given = {
        "age": np.array([one.age for one in robots]),
        "temperature": np.array([_wide(one.temperature, n) for one in robots]),
    }
    return Survey(
        str(folder.head["name"]), folder.path, tuple(robots),
        tuple(one["robot"] for one in members if one.get("outcome") != "completed"),
        standing(np.array([_wide(one.friction, n) for one in robots]), given),
        standing(np.array([_wide(one.change, n) for one in robots]), given),
    )  # fmt: skip


def _model_of(folder: FleetFolder, run: Path) -> Path | None:
    """The model fitted last: by `hil fleet fit` of this fleet, else by the run itself."""
    ours = [one.parent for one in (folder.path / MODELS / robot_of(run)).glob("*/model.json")]
    newest = max(ours, key=lambda one: (one / "model.json").stat().st_mtime, default=None)
    return newest or next(iter(models_below(run)), None)


def _probed(one: Surveyed, registry: Registry) -> Surveyed:
    """With its last probe under the present champion: one before is of another model's errors."""
    try:
        champion = registry.aliases(one.robot).champion
        probes = [each for each in probes_of(registry, one.robot) if each.champion == champion]
    except HilError as error:  # a damaged history is this robot's alone
        return replace(one, problem="; ".join(filter(None, (one.problem, error.message))))
    return replace(one, probe=probes[-1] if probes else None)


def _wide(values: FloatArray, n: int) -> FloatArray:
    return values if len(values) == n else np.full(n, np.nan)


DAYS_A_YEAR = 365.25


@dataclass(frozen=True, slots=True, eq=False)
class Surveyed:
    """One robot as it was measured.

    Attributes:
        robot: Its name.
        run: It was measured in.
        model: Folder of the model fitted to that run.
        age: Years in service on that day; NaN where the station does not say since when it is.
        joint_names: Length n.
        friction: (n,) RMS of what the model says is friction, along the run's trajectories [N·m].
        temperature: (n,) mean of the joints there [°C]; NaN where it is not measured.
        probe: The last probe of that name under its present champion, None without.
        problem: What could not be read of it, else empty.
    """

    robot: str
    run: Path
    model: Path | None
    age: float
    joint_names: tuple[str, ...]
    friction: FloatArray
    temperature: FloatArray
    probe: Probe | None = None
    problem: str = ""

    @property
    def change(self) -> FloatArray:
        """(n,) friction now as a share of the champion's, by the last probe; NaN without one."""
        if self.probe is None:
            return np.full(len(self.joint_names), np.nan)
        told = dict(zip(self.probe.features.names, self.probe.features.values, strict=True))
        return np.array([1.0 + told.get(f"{name} friction", np.nan) for name in self.joint_names])

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet report --json`."""
        return {
            "robot": self.robot,
            "run": str(self.run),
            "model": self.model and str(self.model),
            "age_years": self.age,
            "friction_nm": self.friction.tolist(),
            "temperature_c": self.temperature.tolist(),
            "change": self.change.tolist(),
            "changed": self.probe.changed if self.probe else None,
            "what": self.probe.text if self.probe else None,
            "champion": self.probe.champion if self.probe else None,
            "false_alarm": self.probe.false_alarm if self.probe else None,
            "problem": self.problem or None,
        }


def surveyed(run: Path, model: Path | None) -> Surveyed:
    """One robot, but for its probes; computed by a worker."""
    robot, age = robot_of(run), _age(run)
    try:
        if model is None:
            raise FitError(
                "it has no model: hil fleet fit",
                hint="fit it first: hil fleet fit FOLDER -e ESTIMATOR",
            )
        names, friction, temperature = _friction(run, model)
    except HilError as error:
        none = np.empty(0)
        return Surveyed(robot, run, model, age, (), none, none, problem=error.message)
    return Surveyed(robot, run, model, age, names, friction, temperature)


def _age(run: Path) -> float:
    """Years from the station's `in_service` to the run; NaN where either is not told."""
    try:
        start = read_json(run / "start.json")
        station = load_station(run / "station.yaml", look_up=False)
        since = station.robots[str(start["robot_name"])].in_service
        day = datetime.fromisoformat(str(start["started"])).date()
    except (HilError, KeyError, ValueError):
        return float("nan")
    return float("nan") if since is None else (day - since).days / DAYS_A_YEAR


def _friction(run: Path, model: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    fitted = load_model_file(model)
    data = usable_part(load_source(run), fitted)
    prediction = fitted.predict(data)
    if "friction" not in prediction.components:
        raise FitError(
            f"{fitted.estimator} does not say which part of its prediction is friction",
            hint="fit with an estimator that tells friction apart",
        )
    torque = prediction.components["friction"] * fitted.torque_scale_
    friction: FloatArray = np.sqrt(np.nanmean(torque**2, axis=0))
    measured = "temperature" in data.columns
    celsius = (
        np.nanmean(data["temperature"], axis=0) if measured else np.full(len(friction), np.nan)
    )
    return fitted.joint_names_, friction, celsius


FEWEST = 8
"""Robots below which nothing is said: three of five always look alike."""

MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""

HUBER = 1.345

STEPS = 15

SIMULATED = 1500
"""Fleets of equals; each takes about a millisecond."""

LEAST = 1e-12


def standing(values: FloatArray, given: Mapping[str, FloatArray]) -> Standing | None:
    """Compare the robots of a fleet; None when there are too few.

    Args:
        values: (R, n) positive, per robot and joint; NaN where not known.
        given: By name what it may depend on, (R,) or (R, n); NaN where not known. What most robots
            tell is taken out, and those that do not tell it are not compared; what is the same for
            all explains nothing.
    """
    known = np.all(np.isfinite(values) & (values > 0), axis=1)
    wide = {name: np.broadcast_to(_columns(one), values.shape) for name, one in given.items()}
    silent = {name: known & ~np.isfinite(one).all(axis=1) for name, one in wide.items()}
    unused = tuple(name for name, rows in silent.items() if 0 < known.sum() < 2 * rows.sum())
    left_out = {
        name: tuple(map(int, np.flatnonzero(rows)))
        for name, rows in silent.items()
        if name not in unused and rows.any()
    }
    for rows in left_out.values():
        known[list(rows)] = False
    if known.sum() < FEWEST or not values.shape[1]:
        return None
    y = np.log(values[known])
    n = y.shape[1]
    wide = {name: one[known] for name, one in wide.items()}
    names = tuple(name for name, one in wide.items() if _tells(one))
    # Two columns a joint at most: with as many robots as parameters everybody is explained.
    names = names[: max(0, (len(y) - FEWEST) // 4 + 1)]
    given_by_joint = [np.array([wide[name][:, j] for name in names]) for j in range(n)]
    fits = [_fit_joint(y[:, j], given_by_joint[j].reshape(-1, len(y)), j) for j in range(n)]
    slopes, errors, fitted, scores, largest = zip(*fits, strict=True)
    limit = float(np.quantile(np.max(largest, axis=0), 1 - FAMILY_WISE))
    expected, z = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
    expected[known], z[known] = np.exp(np.column_stack(fitted)), np.column_stack(scores)
    return Standing(
        names, np.column_stack(slopes), np.column_stack(errors), expected, z, limit, left_out,
        tuple(name for name in unused if np.isfinite(given[name]).any()),
    )  # fmt: skip


def _columns(one: FloatArray) -> FloatArray:
    return one[:, None] if one.ndim == 1 else one


def _tells(one: FloatArray) -> bool:
    return bool(np.all(np.isfinite(one)) and np.all(np.ptp(one, axis=0) > 0))


def _fit_joint(
    y: FloatArray, given: FloatArray, joint: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Slopes, their errors, what is explained, z, and the largest |z| of each simulated fleet."""
    spread = np.std(given, axis=1)
    X = np.column_stack([np.ones(len(y)), *((given.T - given.mean(axis=1)) / spread).T])
    beta, scale = huber(X, y[:, None])
    fitted = X @ beta[:, 0]
    largest, deviation = _equals(X.tobytes(), X.shape, joint)
    errors = deviation[1:] * scale[0] / spread
    return beta[1:, 0] / spread, errors, fitted, (y - fitted) / scale[0], largest


@lru_cache(maxsize=64)
def _equals(content: bytes, shape: tuple[int, int], joint: int) -> tuple[FloatArray, FloatArray]:
    """Of fleets whose robots are equal but for noise: largest |z|, and spread of coefficients."""
    X = np.frombuffer(content).reshape(shape)
    noise = np.random.default_rng([20, joint, *shape]).standard_normal((shape[0], SIMULATED))
    beta, scale = huber(X, noise)
    z = np.abs(noise - X @ beta) / scale
    spread: FloatArray = np.std(beta, axis=1)
    largest: FloatArray = np.max(z, axis=0)
    return largest, spread


def huber(X: FloatArray, Y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Huber's regression of many columns at once, scaled by the median absolute deviation.

    Args:
        X: (R, p) with a column of ones.
        Y: (R, M).

    Returns:
        (p, M) coefficients and (M,) scales.
    """
    beta: FloatArray = np.asarray(np.linalg.lstsq(X, Y)[0], dtype=np.float64)
    for _ in range(STEPS):
        residual = np.abs(Y - X @ beta)
        scale = np.maximum(MAD * np.median(residual, axis=0), LEAST)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(residual, LEAST))
        gram = np.einsum("ri,rm,rj->mij", X, weight, X)
        moment = np.einsum("ri,rm->mi", X, weight * Y)
        beta = np.linalg.solve(gram, moment[:, :, None])[:, :, 0].T
    last: FloatArray = np.maximum(MAD * np.median(np.abs(Y - X @ beta), axis=0), LEAST)
    return beta, last


FAMILY_WISE = 0.01
"""Probability that in a fleet of equals anybody stands out at all."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """How the robots of a fleet stand to one another in one quantity.

    Attributes:
        names: Of what the quantity may depend on, such as `age`.
        slopes: (c, n) what a unit of each adds, as a share (0.02 is 2 %).
        errors: (c, n) standard errors of these.
        expected: (R, n) what age and temperature explain.
        z: (R, n) robust z; NaN where a value is missing.
        limit: Above which somebody stands out.
        left_out: By name of a quantity the robots that do not tell it, and so are not compared.
        unused: Quantities that fewer than half of the robots tell, and so explain nothing.
    """

    names: tuple[str, ...]
    slopes: FloatArray
    errors: FloatArray
    expected: FloatArray
    z: FloatArray
    limit: float
    left_out: Mapping[str, tuple[int, ...]]
    unused: tuple[str, ...]

    @property
    def outlying(self) -> BoolArray:
        """(R, n) who stands out."""
        return np.asarray(np.abs(self.z) > self.limit)
