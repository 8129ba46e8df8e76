"""Division of a run into training and hold-out set by whole motions, whole payloads, or both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from hil.core import DataError
from hil.data import Conditions, Dataset, Group, assert_disjoint, group_of, groups, split
from hil.spec import HoldOut

Motion: TypeAlias = tuple[str, Group]
"""Kind (`pose` or `trajectory`) and group of a measured motion."""

NEW_LOAD = "new load, seen motion"
NEW_MOTION = "new motion, seen load"


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Training and hold-out set of a run, made of whole poses, trajectories and payloads.

    Attributes:
        train: Training data.
        test: Hold-out set on which the verdict is based.
        held_out: Description of the hold-out set for the user.
        beside: Held-out series that share payload or motion with the training data, each with a
            description. The series in `beside` are reported, but the verdict does not depend on
            them.
    """

    train: Dataset
    test: Dataset
    held_out: str
    beside: tuple[tuple[str, Dataset], ...] = ()


def hold_out(data: Dataset, how: HoldOut) -> Parts:
    """Return the training and hold-out set that a run specifies.

    Only dwells and trajectories are included.

    Poses and percentages of trajectories are chosen at random by the seed. A number of trajectories
    refers to the last trajectories of the program. If payloads *and* motions are held out, the
    training set contains neither the held-out payloads nor the held-out motions. The hold-out set
    then contains the held-out motions with the held-out payloads, and `beside` contains the two
    other combinations.

    Raises:
        DataError: The training or the hold-out set is empty, or the two sets share samples.
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
        text = f"{what}: motions and payloads that are not in the training data"
        return _checked(Parts(train, part(True, True), text, kept))
    if loads:
        text = f"{_loads(data, loads)}, motions of the training data with other payloads"
        return _checked(Parts(train, part(False, True), text), same_motions=True)
    return _checked(Parts(train, part(True, False), _motions(motions, how)))


def assert_new_pairs(train: Dataset, test: Dataset) -> None:
    """Raise if test and training set share samples, or a motion with the same payload.

    The check is weaker than `assert_disjoint`, and is used for models that are evaluated on a new
    payload.

    Raises:
        DataError: A motion or samples are shared; the message names the shared motion or samples.
    """
    pairs = [{(_motion(c), c.load) for c in data.conditions} for data in (train, test)]
    if shared := pairs[0] & pairs[1]:
        motion, load = min(shared, key=str)
        what = f"{motion[0]} {motion[1][1]}" if motion else "a motion without number"
        raise DataError(
            f"{len(shared)} motion(s) are in both training and test data with the same payload, "
            f"the first is {what} with load {load}",
            hint="hold out complete payloads, or complete motions",
        )
    assert_disjoint(_without_numbers(train), _without_numbers(test))  # only compares the samples


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
    """Return the measured motion of a series; None for a warm-up, a move or a reference visit."""
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
    """Return a description of payloads by their masses, such as `1 kg and 3 kg`.

    If two payloads have the same mass, the description contains payload numbers instead of masses.
    """
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
    texts = {
        "pose": "1 pose" if poses == 1 else f"{poses} poses",
        "trajectory": "the last trajectory"
        if trajectories == 1
        else f"the last {trajectories} trajectories",
    }
    if how.trajectories_percent is not None:
        drawn = ", ".join(str(number) for kind, (_, number) in sorted(motions) if kind != "pose")
        word = "trajectory" if trajectories == 1 else "trajectories"
        texts["trajectory"] = f"{word} {drawn} (drawn, counted from 0)"
    return " and ".join(texts[kind] for kind in count if count[kind])


def _checked(parts: Parts, *, same_motions: bool = False) -> Parts:
    if not len(parts.test):
        raise DataError(
            "no data are held out, so the model cannot be evaluated",
            hint="set validate.hold_out in the spec (trajectories, poses_percent or loads)",
        )
    if not len(parts.train):
        raise DataError(
            "all data are held out, so no data are left for the fit",
            hint="reduce validate.hold_out in the spec",
        )
    (assert_new_pairs if same_motions else assert_disjoint)(parts.train, parts.test)
    for _, other in parts.beside:
        assert_new_pairs(parts.train, other)
    return parts


def _without_numbers(data: Dataset) -> Dataset:
    bare = tuple(replace(c, trajectory=-1, pose=-1) for c in data.conditions)
    return replace(data, conditions=bare)
