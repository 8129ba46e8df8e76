"""What an excitation that computes with the robot's dynamics is given, and how it says how far."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from hil.arms import Payload
from hil.core import FloatArray
from hil.excitation.cache import ExcitationCache

if TYPE_CHECKING:
    from hil.dynamics import RobotModel
    from hil.excitation.optimiser import Distances


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
