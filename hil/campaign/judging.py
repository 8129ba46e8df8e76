"""After the motion: split, fit, evaluate, verdict. Pure functions of the run directory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.data.dataset import Dataset
from hil.data.load import gravity_of, load_source
from hil.data.splits import assert_disjoint, group_of, groups, split
from hil.dynamics import load_model
from hil.errors import DataError
from hil.evaluate import Criterion, Evaluation, Verdict, evaluate, judge
from hil.evaluate.verdict import Metric
from hil.fitting import fit_dataset
from hil.identify.base import HONEST
from hil.record.rundir import RunDirectory
from hil.spec.experiment import Accept, ExperimentSpec, Fit, HoldOut


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One fitted and judged model.

    Attributes:
        estimator: Its name.
        protocol: `honest`, or how the model departs from that; see `RobotEstimator.protocol`.
        folder: `fit/<estimator>-<digest>` of the run.
        held_out: Its errors on data it has not seen.
        trained: Its errors on the data it was fitted to, for comparison only.
        verdict: Whether the held-out errors meet the criteria; not judged unless honest.
    """

    estimator: str
    protocol: str
    folder: Path
    held_out: Evaluation
    trained: Evaluation
    verdict: Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What is fitted on and what is judged on; whole poses, trajectories and loads."""

    train: Dataset
    test: Dataset
    held_out: str


def judge_run(
    directory: RunDirectory, spec: ExperimentSpec, counts: Mapping[str, int]
) -> bool | None:
    """Fit every estimator of the spec to a completed run and judge it on what was held out.

    Writes `fit/…` and `verdict.json` into the run directory. A model that follows a paper's
    protocol instead of an honest one is reported, but never judged.

    Returns:
        Whether all criteria are met; None when the spec has none, or when no criterion is missed
        but no model could be judged.

    Raises:
        DataError, FitError: The data do not allow it.
    """
    data = load_source(directory.path)
    judged = [_judge_one(directory, data, fit, spec) for fit in spec.fit]
    document = _verdict_document(judged, spec, counts)
    directory.write_json("verdict.json", document)
    passed: bool | None = document["passed"]
    return passed


def hold_out(data: Dataset, how: HoldOut) -> Parts:
    """Split measuring series into training and held-out data as a spec says.

    Dwells are held out by pose (both approaches together), trajectories from the end of the
    program, and whole loads where the spec names any.

    Raises:
        DataError: Nothing would be left on one side.
    """
    by_load = [c.load in how.loads for c in data.conditions]
    if any(by_load):
        held = data.select(lambda c: c.load in how.loads)
        kept = data.select(lambda c: c.load not in how.loads)
        return _checked(kept, held, f"loads {', '.join(map(str, how.loads))}")
    if data.of_kind("dwell").conditions:
        parts = split(data.of_kind("dwell"), "pose", how.poses_percent / 100, seed=how.seed)
        return _checked(parts.train, parts.test, f"{len(parts.held_out)} poses")
    trajectories = groups(data, "trajectory")
    if how.trajectories >= len(trajectories):
        raise DataError(
            f"validate.hold_out.trajectories is {how.trajectories}, "
            f"the run has {len(trajectories)} trajectories",
            hint="hold out fewer, or run more trajectories",
        )
    last = set(trajectories[len(trajectories) - how.trajectories :])
    held = data.select(lambda c: group_of(c, "trajectory") in last)
    kept = data.select(lambda c: group_of(c, "trajectory") not in last | {None})
    return _checked(kept, held, f"the last {how.trajectories} trajectories")


def _checked(train: Dataset, test: Dataset, held_out: str) -> Parts:
    if not len(test):
        raise DataError(
            "nothing is held out, so the model cannot be judged",
            hint="set validate.hold_out in the spec (trajectories, poses_percent or loads)",
        )
    assert_disjoint(train, test)
    return Parts(train, test, held_out)


def _judge_one(directory: RunDirectory, data: Dataset, fit: Fit, spec: ExperimentSpec) -> Judged:
    parts = hold_out(data, spec.validation.hold_out)
    robot = load_model(data.robot, gravity=gravity_of(directory.path))
    fitted = fit_dataset(
        parts.train, fit.estimator, robot, out=directory.path / "fit", **fit.parameters
    )
    held_out = evaluate(fitted.model, parts.test, fitted.train_std)
    trained = evaluate(fitted.model, parts.train, fitted.train_std)
    protocol = fitted.model.protocol
    verdict = judge(held_out, criteria_of(spec.accept) if protocol == HONEST else [])
    document = {
        "estimator": fit.estimator,
        "protocol": protocol,
        "seconds": fitted.seconds,
        "held_out": {"what": parts.held_out, **held_out.to_dict()},
        "trained": trained.to_dict(),
        "verdict": verdict.to_dict() | ({} if verdict.judged else {"passed": None}),
    }
    directory.write_json(f"fit/{fitted.folder.name}/evaluation.json", document)
    return Judged(fit.estimator, protocol, fitted.folder, held_out, trained, verdict)


def criteria_of(accept: Accept) -> list[Criterion]:
    """The model criteria of a spec; `gaps_percent` is judged on the recording."""
    out: list[Criterion] = []
    if (rmse := accept.rmse) is not None:
        metric: Metric = "rmse_raw" if rmse.signal == "raw" else "rmse_filtered"
        out.append(Criterion(metric, rmse.max, rmse.unit, rmse.per))
    if (nrmse := accept.nrmse) is not None:
        out.append(Criterion("nrmse", nrmse.max, "", nrmse.per))
    return out


def _verdict_document(
    judged: list[Judged], spec: ExperimentSpec, counts: Mapping[str, int]
) -> dict[str, Any]:
    rows = [
        {"estimator": one.estimator, **row.to_dict()} for one in judged for row in one.verdict.rows
    ]
    rows += _gap_rows(spec.accept, counts)
    unjudged = [
        {"estimator": one.estimator, "protocol": one.protocol}
        for one in judged
        if one.protocol != HONEST
    ]
    passed = all(row["passed"] for row in rows) if rows else None
    if passed and unjudged and len(unjudged) == len(judged):
        passed = None
    return {"passed": passed, "rows": rows, "not_judged": unjudged}


def _gap_rows(accept: Accept, counts: Mapping[str, int]) -> list[dict[str, Any]]:
    if accept.gaps_percent is None:
        return []
    missing = counts["missing"]
    share = 100.0 * missing / max(1, counts["samples"] + missing)
    limit = accept.gaps_percent.max
    return [
        {
            "estimator": "",
            "metric": "gaps_percent",
            "per": "run",
            "what": "recording",
            "value": share,
            "max": limit,
            "unit": "%",
            "passed": share <= limit,
        }
    ]
