"""What an excitation is made of: visits, each a few connected motions measured in one go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from hil.core import FloatArray
from hil.excitation.motion import Hold, Motion
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace


@dataclass(frozen=True, slots=True)
class Action:
    """A step of a plan that does not know its number and load yet (see `hil.planning.Step`)."""

    kind: Literal["warmup", "move", "dwell", "trajectory", "reference", "weigh"]
    motion: Motion
    pose: int = -1
    trajectory: int = -1
    approach: int = 0
    checkpoint: bool = False


@dataclass(frozen=True, slots=True)
class Visit:
    """One pose or one trajectory: connected motions, clear in themselves.

    Attributes:
        actions: In order; each motion starts where the one before it ended.
        label: What messages call it, e.g. `waypoints.csv:12`.
    """

    actions: tuple[Action, ...]
    label: str

    @property
    def entry(self) -> FloatArray:
        """(n,) where the arm has to be before the visit."""
        return self.actions[0].motion.q_start

    @property
    def exit(self) -> FloatArray:
        """(n,) where the visit leaves the arm."""
        return self.actions[-1].motion.q_end

    @property
    def motions(self) -> list[Motion]:
        """The motions of the actions."""
        return [action.motion for action in self.actions]


@dataclass(frozen=True, slots=True)
class Program:
    """The visits of an excitation.

    Attributes:
        visits: What is to be measured.
        spares: What may stand in for visits that cannot be reached.
        shuffle_seed: Seed for a random order; None to keep the order given.
    """

    visits: Sequence[Visit]
    spares: Sequence[Visit] = ()
    shuffle_seed: int | None = None


class Excitation(Protocol):
    """What the entry points `hil.excitations` provide: `Kind(spec, folder).program(roadmap)`."""

    def program(self, roadmap: Roadmap) -> Program:
        """The visits, all within the limits of `roadmap.workspace` and clear in themselves.

        Raises:
            SpecError: The spec or a file it names asks for something that cannot be.
            PlanError: Too few visits are possible in this workspace.
        """


def pose_visit(
    workspace: Workspace,
    q: FloatArray,
    approach: Literal["both", "positive", "negative", "free"],
    delta_rad: float,
    *,
    label: str,
    kind: Literal["dwell", "reference", "weigh"] = "dwell",
    pose: int = -1,
) -> Visit:
    """Dwell at `q` (n,), once per approach.

    From below means: from q − δ in every joint at once, so that friction has the same sign
    everywhere and its two signs frame the gravity torque.
    """
    hold = Hold(tuple(map(float, q)))
    if approach == "free":
        return Visit((Action(kind, hold, pose=pose, checkpoint=True),), label)
    signs = {"both": (1, -1), "positive": (1,), "negative": (-1,)}[approach]
    actions: list[Action] = []
    for sign in signs:
        away = q - sign * delta_rad
        if actions:
            actions.append(Action("move", workspace.line(q, away)))
        actions.append(Action("move", workspace.line(away, q)))
        actions.append(Action(kind, hold, pose=pose, approach=sign))
    return Visit(tuple(actions), label)
