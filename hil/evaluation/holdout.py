"""What of a run is fitted on and what is judged on: whole motions, whole loads, or both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from hil.core import DataError
from hil.data import Conditions, Dataset, Group, assert_disjoint, group_of, groups, split
from hil.spec import HoldOut

Motion: TypeAlias = tuple[str, Group]
"""`pose` or `trajectory`, and which one."""

NEW_LOAD = "new load, seen motion"
NEW_MOTION = "new motion, seen load"


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What is fitted on and what is judged on; whole poses, trajectories and loads.

    Attributes:
        train: What the fit sees.
        test: What the verdict is about.
        held_out: What `test` is, in words.
        beside: Held-out series that share the load or the motion with the training; reported,
            but not judged.
    """

    train: Dataset
    test: Dataset
    held_out: str
    beside: tuple[tuple[str, Dataset], ...] = ()


def hold_out(data: Dataset, how: HoldOut) -> Parts:
    """Split measuring series (dwells and trajectories) as a spec says; others are left out.

    Poses and shares of trajectories are drawn by seed; a number of trajectories are the last ones
    of the program. Where loads *and*
    motions are held out, the model is fitted on neither: it is judged on the held-out motions
    under the held-out loads, and the two other combinations are kept apart in `beside`.

    Raises:
        DataError: Nothing would be left on one side, or the sides share samples.
    """
    motions = _held_motions(data, how)
    loads = set(how.loads)

    def part(new_motion: bool, new_load: bool) -> Dataset:
        return data.select(_of(motions, loads, new_motion, new_load))

    train = part(False, False)
    if motions and loads:
        beside = ((NEW_LOAD, part(False, True)), (NEW_MOTION, part(True, False)))
        kept = tuple((what, found) for what, found in beside if found.conditions)
        what = f"{_motions(motions, how)} with {_loads(data, loads)}"
        said = f"{what}: motions and loads the fit has not seen"
        return _checked(Parts(train, part(True, True), said, kept))
    if loads:
        said = f"{_loads(data, loads)}, motions seen in training with other loads"
        return _checked(Parts(train, part(False, True), said), same_motions=True)
    return _checked(Parts(train, part(True, False), _motions(motions, how)))


def assert_new_pairs(train: Dataset, test: Dataset) -> None:
    """Refuse a test set that shares a motion under the same load, or samples, with the training.

    The weaker sister of `assert_disjoint`, for models judged on a load they have not seen.

    Raises:
        DataError: Something is shared; the message names it.
    """
    pairs = [{(_motion(c), c.load) for c in data.conditions} for data in (train, test)]
    if shared := pairs[0] & pairs[1]:
        motion, load = min(shared, key=str)
        what = f"{motion[0]} {motion[1][1]}" if motion else "a motion without number"
        raise DataError(
            f"{len(shared)} motion(s) are in both training and test data under the same load, "
            f"the first is {what} with load {load}",
            hint="hold out whole loads, or whole motions",
        )
    assert_disjoint(_without_numbers(train), _without_numbers(test))  # what is left: the samples


def _held_motions(data: Dataset, how: HoldOut) -> set[Motion]:
    return _held_poses(data.of_kind("dwell"), how) | _held_trajectories(
        data.of_kind("trajectory"), how
    )


def _held_poses(dwells: Dataset, how: HoldOut) -> set[Motion]:
    total = len(groups(dwells, "pose"))
    count = how.poses_of(total)
    if not (total and count):
        return set()
    return {("pose", group) for group in split(dwells, "pose", count, seed=how.seed).held_out}


def _held_trajectories(data: Dataset, how: HoldOut) -> set[Motion]:
    there = groups(data, "trajectory")
    count = how.trajectories_of(len(there))
    if there and count >= len(there):
        raise DataError(
            f"validate.hold_out.trajectories is {count}, the run has {len(there)} trajectories",
            hint="hold out fewer, or run more trajectories",
        )
    if not (there and count):
        return set()
    chosen = there[len(there) - count :]
    if how.trajectories_percent is not None:
        chosen = split(data, "trajectory", count, seed=how.seed).held_out
    return {("trajectory", group) for group in chosen}


def _motion(condition: Conditions) -> Motion | None:
    """What was measured; None for a warm-up, a move between two poses, a reference visit."""
    if condition.kind == "dwell":
        group = group_of(condition, "pose")
        return None if group is None else ("pose", group)
    if condition.kind == "trajectory":
        group = group_of(condition, "trajectory")
        return None if group is None else ("trajectory", group)
    return None


def _of(
    motions: set[Motion], loads: set[int], new_motion: bool, new_load: bool
) -> Callable[[Conditions], bool]:
    def chosen(condition: Conditions) -> bool:
        motion = _motion(condition)
        if motion is None:
            return False
        return (motion in motions, condition.load in loads) == (new_motion, new_load)

    return chosen


def _loads(data: Dataset, loads: set[int]) -> str:
    """By mass, `1 kg and 3 kg`; by number where one mass is mounted twice."""
    masses = {condition.load: f"{condition.payload.mass:.4g} kg" for condition in data.conditions}
    known = list(masses.values())
    names = [
        masses[load] if known.count(masses.get(load, "")) == 1 else f"load {load}"
        for load in sorted(loads)
    ]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _motions(motions: set[Motion], how: HoldOut) -> str:
    count = {kind: sum(k == kind for k, _ in motions) for kind in ("pose", "trajectory")}
    poses, trajectories = count["pose"], count["trajectory"]
    said = {
        "pose": "1 pose" if poses == 1 else f"{poses} poses",
        "trajectory": "the last trajectory"
        if trajectories == 1
        else f"the last {trajectories} trajectories",
    }
    if how.trajectories_percent is not None:
        drawn = ", ".join(str(number) for kind, (_, number) in sorted(motions) if kind != "pose")
        word = "trajectory" if trajectories == 1 else "trajectories"
        said["trajectory"] = f"{word} {drawn} (drawn, counted from 0)"
    return " and ".join(said[kind] for kind in count if count[kind])


def _checked(parts: Parts, *, same_motions: bool = False) -> Parts:
    if not len(parts.test):
        raise DataError(
            "nothing is held out, so the model cannot be judged",
            hint="set validate.hold_out in the spec (trajectories, poses_percent or loads)",
        )
    if not len(parts.train):
        raise DataError(
            "everything is held out, so there is nothing to fit on",
            hint="hold out less: validate.hold_out in the spec",
        )
    (assert_new_pairs if same_motions else assert_disjoint)(parts.train, parts.test)
    for _, other in parts.beside:
        assert_new_pairs(parts.train, other)
    return parts


def _without_numbers(data: Dataset) -> Dataset:
    bare = tuple(replace(c, trajectory=-1, pose=-1) for c in data.conditions)
    return replace(data, conditions=bare)
