"""The fit of one robot of a fleet: stored, and registered under its robot's name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil.core import DataError, read_json
from hil.estimators import write_whole
from hil.evaluation import VerdictWord, verdict_word
from hil.models.facts import facts_of
from hil.models.fleet_fit_task import FitResult
from hil.models.model_registry import Registry


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
