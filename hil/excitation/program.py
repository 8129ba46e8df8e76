"""What an excitation is, what it is given, and the visits it gives back.

An excitation (entry point `hil.excitations`) turns a roadmap of the workspace into a `Program` of
visits, each a few connected motions measured in one go. One that computes with the robot's
dynamics also gets a `Setting`, and says how far it is by `Advance`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from hil.arms import Payload
from hil.core import FloatArray
from hil.excitation.cache import ExcitationCache
from hil.excitation.motion import Hold, Motion
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Distances, Workspace

if TYPE_CHECKING:
    from hil.dynamics import RobotModel


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


@dataclass(frozen=True, slots=True)
class Advance:
    """How far a computation of trajectories is.

    Attributes:
        trajectory, trajectories: Number of the one at work, from 1, and of all; 0 for a note.
        start, starts: The same for its random starts.
        best: Condition number reached so far; infinite while there is none, or none is asked for.
        left_s: Time that is probably left for all of them, None where nothing can be said yet.
        note: Something to be told once.
    """

    trajectory: int = 0
    trajectories: int = 0
    start: int = 0
    starts: int = 0
    best: float = float("inf")
    left_s: float | None = None
    note: str = ""

    def to_event(self) -> dict[str, Any]:
        """What observers of a run are told."""
        return {"kind": "excitation"} | asdict(self)

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> Advance:
        """Inverse of `to_event`."""
        return cls(**{name: value for name, value in event.items() if name in cls.__slots__})


Watch = Callable[[Advance], None]


def unwatched(advance: Advance) -> None:
    """Tells nobody."""


@dataclass(frozen=True, eq=False)
class Setting:
    """A robot at its place, as far as its dynamics go.

    Attributes:
        robot: The arm without load, mounted as the station says.
        effort_max: (n,) its torque limits [N·m].
        loads: Every load of the experiment.
        collision: Distances with the largest of the loads.
        identity: Everything about arm and surroundings that motions depend on, as JSON.
        cache: Where results are kept.
        watch: Is told how far it is.
    """

    robot: RobotModel
    effort_max: FloatArray
    loads: tuple[Payload, ...]
    collision: Distances
    identity: Mapping[str, Any]
    cache: ExcitationCache = field(default_factory=ExcitationCache)
    watch: Watch = unwatched

    @property
    def heaviest(self) -> Payload:
        """The load that torques are computed with."""
        return max(self.loads, key=lambda load: load.mass)


@runtime_checkable
class Computes(Protocol):
    """An excitation that needs more than a roadmap."""

    def compute_with(self, setting: Setting) -> None:
        """Called once, before `program`."""
