"""Fitted models as PyTorch modules, whatever kind they are of."""

from __future__ import annotations

import json
from dataclasses import dataclass

from torch import nn

from hil.estimators import RobotEstimator
from hil.export.exported import effort_unit
from hil.export.reading import program_of
from hil.export.torch_program import ProgramModule

LOAD = ("kg", *["m"] * 3, *["kg*m2"] * 6)
"""Units of mass, centre of mass x y z and inertia about it xx yy zz xy xz yz."""


@dataclass(frozen=True, slots=True, eq=False)
class TorchModel:
    """A module and what has to be known to call it.

    Attributes:
        module: effort[, state_next] = module(q, qd, qdd, load[, state]), a tuple; see
            `torch_program.ProgramModule`. In double precision, for evaluation.
        estimator: What found it.
        joint_names: n of them.
        effort_kind: `current` or `torque`.
        turns: Which joints turn; the others slide.
        state: Name and size of the parts of the state, in this order; empty without memory.
        rate_hz: At which samples must come, as a network counts them; None where it does not
            matter.
    """

    module: nn.Module
    estimator: str
    joint_names: tuple[str, ...]
    effort_kind: str
    turns: tuple[bool, ...]
    state: tuple[tuple[str, int], ...] = ()
    rate_hz: float | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def state_size(self) -> int:
        """S; 0 without memory."""
        return sum(size for _, size in self.state)

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Of the inputs and of the outputs."""
        taken, given = ("q", "qd", "qdd", "load"), ("effort",)
        return ((*taken, "state"), (*given, "state_next")) if self.state else (taken, given)

    @property
    def units(self) -> dict[str, list[str]]:
        """Of every column of the inputs and of the effort, in ASCII."""
        lengths = ["rad" if turns else "m" for turns in self.turns]
        of_torque = ["N*m" if turns else "N" for turns in self.turns]
        return {
            "q": lengths,
            "qd": [f"{one}/s" for one in lengths],
            "qdd": [f"{one}/s2" for one in lengths],
            "load": list(LOAD),
            "effort": of_torque if self.effort_kind == "torque" else ["A"] * self.n,
        }

    def told(self) -> dict[str, str]:
        """Metadata for a file: plain text, lists as JSON."""
        return {
            "written_by": "hil",
            "estimator": self.estimator,
            "joint_names": json.dumps(self.joint_names),
            "units": json.dumps(self.units),
            "effort_unit": effort_unit(self.effort_kind).replace("·", "*"),
            "state_size": str(self.state_size),
            "state": json.dumps(self.state),
            "rate_hz": "" if self.rate_hz is None else f"{self.rate_hz:.9g}",
        }


def module_of(model: RobotEstimator) -> TorchModel:
    """What the model computes, as a PyTorch module.

    Raises:
        FitError: It is not fitted, or of a kind that is not exported.
    """
    program = program_of(model)
    module = ProgramModule(program).eval()
    correction = program.correction if module.network is not None else None
    return TorchModel(
        module=module,
        estimator=program.estimator,
        joint_names=program.joint_names,
        effort_kind=program.effort_kind,
        turns=tuple(bool(turns) for turns in program.geometry.turns),
        state=module.parts,
        rate_hz=None if correction is None else correction.networks[0].rate_hz,
    )
