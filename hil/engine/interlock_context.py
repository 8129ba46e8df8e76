"""What interlocks need to know about robot, surroundings and recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from hil.core import FloatArray
from hil.robot import ClockKind, EffortKind
from hil.spec import WorkspaceInterlock


class Distances(Protocol):
    """R distances that follow from the joint positions.

    `hil.dynamics.sample_distances.SampleDistances` and `hil.dynamics.flange.FlangeSpace` are such.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """(R,) between which two things."""

    @property
    def reach(self) -> FloatArray:
        """(R, n) metres that each can change per radian of each joint, at most."""

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n)."""

    def own(self) -> Distances:
        """The same distances for another thread."""


@dataclass(frozen=True, slots=True, eq=False)
class InterlockContext:
    """What is known of one run; whatever is left out cannot be watched.

    Attributes:
        joint_names: Length n.
        effort_kind: What the robot measures, see `Capabilities`.
        drive_gains: Torque per current [N·m/A] per joint, empty when unknown.
        effort_max: The robot's own torque limits [N·m] per joint, empty when unknown.
        clearance: Distances of the arm with its loads to itself and everything around; None for
            an arm without collision bodies.
        clearance_m: Distance [m] that the plan keeps.
        flange: Distances of flange and payload to the faces of a workspace; None when nobody can
            tell where the flange is.
        behind_s: How far writing is behind reading [s], for `check`; None if nothing is recorded.
        folder: The run directory, for `check`; None if nothing is recorded.
        speed_scaling: Executed over planned speed, the lowest of the newest block; None for a
            robot that does not report it.
        clock: `virtual` robots stand still while the recorder catches up.
    """

    joint_names: tuple[str, ...] = ()
    effort_kind: EffortKind = "current"
    drive_gains: tuple[float, ...] = ()
    effort_max: tuple[float, ...] = ()
    clearance: Distances | None = None
    clearance_m: float = 0.0
    flange: Callable[[WorkspaceInterlock], Distances] | None = None
    behind_s: Callable[[], float] | None = None
    folder: Callable[[], Path] | None = None
    speed_scaling: Callable[[], float] | None = None
    clock: ClockKind = "wall"
