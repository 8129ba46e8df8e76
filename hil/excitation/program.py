"""Interface of an excitation: its inputs, and the program of visits that it returns.

An excitation (entry point `hil.excitations`) turns a roadmap of the workspace into a `Program` of
visits. Each visit consists of a few connected motions that are measured together. An excitation
that needs the robot dynamics also receives a `Setting`, and reports its progress as `Advance`.
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
    """Step of a plan, without its step number and load (see `hil.planning.Step`)."""

    kind: Literal["warmup", "move", "dwell", "trajectory", "reference", "weigh"]
    motion: Motion
    pose: int = -1
    trajectory: int = -1
    approach: int = 0
    checkpoint: bool = False


@dataclass(frozen=True, slots=True)
class Visit:
    """Visit to one pose or one trajectory: connected motions, all clear of collisions.

    Attributes:
        actions: Actions of the visit in order; each motion starts at the end of the previous
            motion.
        label: Name of the visit in messages, such as `waypoints.csv:12`.
    """

    actions: tuple[Action, ...]
    label: str

    @property
    def entry(self) -> FloatArray:
        """Position of the arm that is required before the visit, (n,)."""
        return self.actions[0].motion.q_start

    @property
    def exit(self) -> FloatArray:
        """Position of the arm after the visit, (n,)."""
        return self.actions[-1].motion.q_end

    @property
    def motions(self) -> list[Motion]:
        """Motions among the actions of the visit."""
        return [action.motion for action in self.actions]


@dataclass(frozen=True, slots=True)
class Program:
    """Visits that an excitation requests.

    Attributes:
        visits: Visits that are measured.
        spares: Spare visits that replace visits that cannot be reached.
        shuffle_seed: Seed for a random order of the visits; None to retain the order of `visits`.
    """

    visits: Sequence[Visit]
    spares: Sequence[Visit] = ()
    shuffle_seed: int | None = None


class Excitation(Protocol):
    """Interface of the entry points `hil.excitations`: `Kind(spec, folder).program(roadmap)`."""

    def program(self, roadmap: Roadmap) -> Program:
        """Return the program of visits, all clear and within the limits of `roadmap.workspace`.

        Raises:
            SpecError: The spec, or a file named in the spec, contains an impossible request.
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
    """Return a visit that dwells at `q` (n,) once per approach direction.

    The approach in positive direction starts at q − δ in all joints simultaneously. With
    simultaneous approach, friction has the same sign in all joints, and the gravity torque lies
    between the torques of the two approach directions.
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
    """Progress of the computation of trajectories.

    Attributes:
        trajectory, trajectories: Number of the current trajectory, from 1, and total number of
            trajectories; 0 if the event is only a note.
        start, starts: Number of the current random start, and total number of starts.
        best: Best condition number so far; infinite if there is none yet or if the objective is not
            the condition number.
        left_s: Estimated time for all remaining trajectories [s], None if no estimate is possible
            yet.
        note: Message that is shown one time; empty for none.
    """

    trajectory: int = 0
    trajectories: int = 0
    start: int = 0
    starts: int = 0
    best: float = float("inf")
    left_s: float | None = None
    note: str = ""

    def to_event(self) -> dict[str, Any]:
        """Return the progress as an event for the observers of a run."""
        return {"kind": "excitation"} | asdict(self)

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> Advance:
        """Return the progress described by an event; the inverse of `to_event`."""
        return cls(**{name: value for name, value in event.items() if name in cls.__slots__})


Watch = Callable[[Advance], None]


def unwatched(advance: Advance) -> None:
    """Ignore the progress."""


@dataclass(frozen=True, eq=False)
class Setting:
    """Robot in its station, with all data that are needed to compute its dynamics.

    Attributes:
        robot: Model of the arm without payload, mounted as in the station.
        effort_max: (n,) torque limits [N·m].
        loads: All payloads of the experiment.
        collision: Distances between bodies for the arm with the largest payload.
        identity: JSON object with all properties of arm and surroundings that affect the motions.
        cache: Cache of computed trajectories.
        watch: Callback that receives the progress of the computation.
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
        """Payload with the largest mass; nominal torques are computed with this payload."""
        return max(self.loads, key=lambda load: load.mass)


@runtime_checkable
class Computes(Protocol):
    """Interface of an excitation that needs the robot dynamics in addition to a roadmap."""

    def compute_with(self, setting: Setting) -> None:
        """Store the robot and its payloads; called exactly one time, before `program`."""
