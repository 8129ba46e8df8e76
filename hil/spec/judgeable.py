"""Whether the criteria of a spec can be applied to what a robot measures; asked before motion."""

from __future__ import annotations

from typing import NamedTuple

from hil.core import KeyPath, SpecError, dotted
from hil.spec.experiment import ExperimentSpec

UNITS = {"current": "A", "torque": "N·m"}
"""Unit of each kind of effort."""


class Excess(NamedTuple):
    """A value of a spec that a robot rules out, and why."""

    path: KeyPath
    message: str

    def __str__(self) -> str:
        return f"{dotted(self.path)}: {self.message}"


def misjudged(spec: ExperimentSpec, effort_kind: str) -> list[Excess]:
    """The criteria in another unit than the robot's effort.

    Args:
        spec: The experiment.
        effort_kind: What the robot measures, `current` or `torque` (`Capabilities.effort_kind`).
    """
    limit, unit = spec.accept.rmse, UNITS.get(effort_kind, "")
    if limit is None or limit.unit.replace("Nm", "N·m") == unit:
        return []
    instead = f"give the limit in {unit}" if unit else "accept: {nrmse: …} needs no unit"
    message = (
        f"the limit is in {limit.unit}, but {spec.robot} measures a {effort_kind} "
        f"in {unit or 'an unknown unit'}: {instead}"
    )
    return [Excess(("accept", "rmse", "unit"), message)]


def require_judgeable(spec: ExperimentSpec, effort_kind: str) -> None:
    """Refuse criteria in another unit than the robot's effort.

    Args:
        spec: The experiment.
        effort_kind: As of `misjudged`.

    Raises:
        SpecError: `accept.rmse.unit` is the unit of something else.
    """
    if found := misjudged(spec, effort_kind):
        raise SpecError(
            f"{spec.name}: {found[0]}", hint="`accept: {nrmse: …}` is a limit without a unit"
        )
