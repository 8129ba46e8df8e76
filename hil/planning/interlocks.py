"""Whether a plan lets its own interlocks be: what would trip for certain is refused before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hil.arms import ArmDescription
from hil.core import PlanError
from hil.dynamics import FlangeSpace, Plane, least_along
from hil.planning.plan import Step
from hil.planning.surroundings import BodySize
from hil.spec import ClearanceInterlock, Interlock, WorkspaceInterlock


def flange_space(
    arm: ArmDescription, space: WorkspaceInterlock, sizes: Sequence[BodySize | None]
) -> FlangeSpace:
    """Distances of the flange, and of the tip of the longest load, to the faces of a workspace.

    One tip stands for all loads, as one body does in collisions. A load of unknown size has none.

    Args:
        arm: The arm.
        space: Box and planes.
        sizes: Of each load's body, None where it is not known.
    """
    return FlangeSpace(arm, _faces(space), _tip_m(sizes))


def declared_space(
    interlocks: Sequence[Interlock], arm: ArmDescription, sizes: Sequence[BodySize | None]
) -> FlangeSpace | None:
    """Return the space that all workspace interlocks of a spec leave to the flange, if any does.

    Its faces are named by their interlocks: `x of max_m (interlocks.1)`.

    Args:
        interlocks: Of the spec.
        arm: The arm.
        sizes: Of each load's body, None where it is not known.
    """
    faces = [
        replace(face, name=f"{face.name} (interlocks.{number})")
        for number, interlock in enumerate(interlocks)
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled
        for face in _faces(interlock)
    ]
    return FlangeSpace(arm, faces, _tip_m(sizes)) if faces else None


def interlock_margins(
    interlocks: Sequence[Interlock],
    arm: ArmDescription,
    sizes: Sequence[BodySize | None],
    steps: Sequence[Step],
    rate_hz: float,
    clearance_m: float,
) -> dict[str, float]:
    """`workspace_m`: smallest distance of the flange to a face of its workspace, if it has one.

    Args:
        interlocks: Of the spec.
        arm: The arm.
        sizes: Of each load's body.
        steps: Of the plan.
        rate_hz: At which motions are sampled.
        clearance_m: Smallest distance of the plan to anything.

    Raises:
        PlanError: The motion itself trips an interlock; all that it trips are listed.
    """
    moving = [step for step in steps if step.motion is not None]
    margins: list[float] = []
    problems: list[str] = []
    for number, interlock in enumerate(interlocks):
        problem = ""
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled:
            space = flange_space(arm, interlock, sizes)
            least, problem = _least(space, moving, rate_hz)
            margins.append(least)
        elif isinstance(interlock, ClearanceInterlock) and interlock.enabled:
            problem = _too_close(interlock, clearance_m)
        if problem:
            problems.append(f"interlocks.{number} ({interlock.kind}): {problem}")
    if problems:
        raise PlanError(
            "\n".join(problems),
            hint="change these entries, or restrict the motion: excitation.range_deg or the poses "
            "of excitation.file",
        )
    return {"workspace_m": min(margins)} if margins else {}


def _least(space: FlangeSpace, steps: Sequence[Step], rate_hz: float) -> tuple[float, str]:
    """The smallest distance of steps that move to a face, and what is wrong with it."""
    paths = [step.motion.sample(rate_hz).q for step in steps if step.motion is not None]
    found = [least_along(q, space.distances, space.reach) for q in paths]
    at, (least, sample) = min(enumerate(found), key=lambda item: item[1][0])
    if least >= 0:
        return least, ""
    point, face = space.names[int(space.distances(paths[at][[sample]])[:, 0].argmin())]
    place = f"step {steps[at].index} ({steps[at].kind})"
    return least, f"{place} takes the {point} {-1e3 * least:.1f} mm beyond {face}"


def _too_close(interlock: ClearanceInterlock, clearance_m: float) -> str:
    if interlock.least_m is None or interlock.least_m < clearance_m:
        return ""
    return (
        f"least_m is {interlock.least_m:g}, but the plan itself comes as close as "
        f"{clearance_m:.4f} m to something"
    )


def _tip_m(sizes: Sequence[BodySize | None]) -> float:
    """Return how far the longest load reaches beyond the flange."""
    return max((size[0] for size in sizes if size is not None), default=0.0)


def _faces(space: WorkspaceInterlock) -> list[Plane]:
    faces = [Plane(wall.point_m, wall.normal, wall.name) for wall in space.planes]
    for key, corner, inwards in (("min_m", space.min_m, 1.0), ("max_m", space.max_m, -1.0)):
        if corner is not None:
            faces += [
                Plane(corner, (inwards * (i == 0), inwards * (i == 1), inwards * (i == 2)), name)
                for i, name in enumerate(f"{axis} of {key}" for axis in "xyz")
            ]
    return faces
