"""Whether the criteria of a spec can be applied to what a robot measures; asked before motion."""

from __future__ import annotations

from hil.errors import SpecError
from hil.spec.experiment import ExperimentSpec

UNITS = {"current": "A", "torque": "N·m"}
"""Unit of each kind of effort."""


def require_judgeable(spec: ExperimentSpec, effort_kind: str) -> None:
    """Refuse criteria in another unit than the robot's effort.

    Args:
        spec: The experiment.
        effort_kind: What the robot measures, `current` or `torque` (`Capabilities.effort_kind`).

    Raises:
        SpecError: `accept.rmse.unit` is the unit of something else.
    """
    limit, unit = spec.accept.rmse, UNITS.get(effort_kind, "")
    if limit is None or limit.unit.replace("Nm", "N·m") == unit:
        return
    raise SpecError(
        f"accept.rmse.unit of {spec.name} is {limit.unit}, but {spec.robot} measures a "
        f"{effort_kind} in {unit or 'an unknown unit'}",
        hint=f"give the limit in {unit}" if unit else "accept: {nrmse: …} needs no unit",
    )
