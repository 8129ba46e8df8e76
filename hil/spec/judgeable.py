"""Checks before the motion that a robot measures what the criteria of a spec need."""

from __future__ import annotations

from typing import NamedTuple

from hil.core import KeyPath, SpecError, dotted
from hil.spec.experiment import ExperimentSpec

UNITS = {"current": "A", "torque": "N·m"}
"""Unit of the effort, by kind of effort."""


class Excess(NamedTuple):
    """Entry of a spec that is impossible with a robot, and the reason."""

    path: KeyPath
    message: str

    def __str__(self) -> str:
        return f"{dotted(self.path)}: {self.message}"


def misjudged(spec: ExperimentSpec, effort_kind: str) -> list[Excess]:
    """Return the criteria whose unit differs from the unit of the robot's effort.

    Args:
        spec: Spec of the experiment.
        effort_kind: Quantity that the robot measures, `current` or `torque`
            (`Capabilities.effort_kind`).
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
    """Raise if a criterion has a different unit than the robot's effort.

    Args:
        spec: Spec of the experiment.
        effort_kind: Quantity that the robot measures, as for `misjudged`.

    Raises:
        SpecError: The unit `accept.rmse.unit` is not the unit of the robot's effort.
    """
    if found := misjudged(spec, effort_kind):
        raise SpecError(
            f"{spec.name}: {found[0]}", hint="a limit without a unit: `accept: {nrmse: …}`"
        )
