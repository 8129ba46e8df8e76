"""Confirmation of motion without an operator at each run: robots named in a file, confirmed once.

A schedule, a series and a fleet run experiments one after the other or at the same time. Their file
names every real robot with its address (`robots: {ur5: 192.168.0.5}`). A series and a fleet are
confirmed when they are started, all robots at once (`confirm_together`). A schedule is armed
(`arm`), and the record beside its ledger holds until its file, an experiment, the robot's entry in
the station, or the description of its arm changes. Each run compares again before it moves, as
files may change while a schedule is running.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hil.arms import model_sha256
from hil.core import (
    DataError,
    HilError,
    NotConfirmed,
    SpecError,
    json_document,
    read_json,
    write_replacing,
)
from hil.planning import Experiment, opened
from hil.recording import operator as this_user
from hil.recording import utc_now
from hil.robot import UNKNOWN, address_of
from hil.spec import spec_hash
from hil.workflow.console import Console
from hil.workflow.motion_confirmation import (
    TYPED,
    Confirm,
    Granted,
    MotionFacts,
    Unconfirmed,
    digest_of,
    motion_facts,
    typed_line,
)
from hil.workflow.preview import planned

Document = dict[str, Any]

ARMED_FILE = "armed.json"
FORMAT = 1

NOT_INCLUDED = (
    "Planned without the robot: the way from where it stands to the first pose is not included."
)


@dataclass(frozen=True, slots=True)
class Moves:
    """The motions of a schedule, a series or a fleet.

    Attributes:
        file: File that names the robots and their addresses.
        named: Name of a robot → address, as in the file.
        experiments: Place in the file (`probe`, `series.0`) → experiment.
    """

    file: Path
    named: Mapping[str, str]
    experiments: Mapping[str, Experiment]

    def real(self) -> tuple[Experiment, ...]:
        """Return the experiments whose robots are real; nothing is connected.

        Raises:
            SpecError: The file does not name one of these robots, or names another address, or a
                driver states no address.
        """
        real: list[Experiment] = []
        wrong: list[str] = []
        addresses: dict[str, str] = {}
        for experiment in self.experiments.values():
            name = experiment.spec.robot
            try:
                with opened(name, experiment.robot) as robot:
                    at = address_of(robot)
            except (HilError, TypeError, ValueError):
                continue  # its run reports that, and moves no robot that was not confirmed
            if not at.real:
                continue
            if at.text == UNKNOWN:
                raise SpecError(
                    f"{self.file}: robots: {name} is a real robot ({experiment.station_source}), "
                    f"and its driver {experiment.robot.driver!r} does not state an address",
                    hint="add the property `address` (hil.robot.HasAddress) to the driver: only an "
                    "address distinguishes one robot from another",
                )
            real.append(experiment)
            addresses[name] = at.text
            where = f"{name} is a real robot at {at.text} ({experiment.station_source})"
            if name not in self.named:
                wrong.append(f"{self.file}: robots: {where}, and the file does not name it")
            elif self.named[name] != at.text:
                wrong.append(f"{self.file}: robots: {where}, the file has {self.named[name]}")
        if wrong:
            pairs = ", ".join(f'{name}: "{address}"' for name, address in addresses.items())
            raise SpecError(
                "\n".join(dict.fromkeys(wrong)),
                hint=f"to allow these robots, add to the file: robots: {{{pairs}}}",
            )
        return tuple(real)


@dataclass(frozen=True, slots=True)
class Rechecked:
    """A confirmation that is looked up again before each motion; implements `Confirm`.

    Attributes:
        granted: Return what was confirmed for a robot, or raise `NotConfirmed`.
    """

    granted: Callable[[str], Granted]

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        self.granted(robot).admit(robot, address)

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`; the plan exists by now, so a file that changed before it is noticed."""
        return self.granted(facts.robot)(facts, meanwhile)


@dataclass(frozen=True, slots=True)
class Together:
    """The confirmation of a series or a fleet, given at its start.

    Attributes:
        file: File that names the robots and their addresses.
        named: Name of a robot → address, as in the file.
        how: `typed` or `--yes`.
        by: User who confirmed.
        digests: Of each experiment that moves a real robot.
    """

    file: Path
    named: Mapping[str, str]
    how: str
    by: str
    digests: tuple[Mapping[str, str], ...]

    def begin(self, experiment: Experiment) -> Confirm:
        """Return the confirmation of an experiment; it holds while the experiment is unchanged."""
        return Rechecked(partial(self._granted, experiment))

    def resume(self, robot: str, run: Path) -> Confirm:
        """Return the confirmation of a run that was begun and confirmed earlier.

        A typed name is for the runs that begin; `--yes` is for all robots that the file names.
        """
        if self.how != TYPED and robot in self.named:
            return self._at(robot)
        return Unconfirmed(hint=f"resume this run by itself: hil resume {run}")

    def _at(self, robot: str) -> Granted:
        return Granted(self.how, self.by, {"robot": robot, "address": self.named[robot]})

    def _granted(self, experiment: Experiment, robot: str) -> Granted:
        now = _digests_of(experiment)
        if now in self.digests:
            return self._at(robot)
        of_robot = [one for one in self.digests if _entry(robot) in one]
        if not of_robot:
            raise NotConfirmed(
                f"{robot} is a real robot, and was not confirmed when {self.file} was started",
                hint=f"add it with its address to {self.file}: robots: {{…}}, and start again",
            )
        changed = [what for what in now if all(now[what] != one.get(what) for one in of_robot)]
        raise NotConfirmed(
            f"{robot} was confirmed when {self.file} was started; changed since: "
            f"{', '.join(changed or now)}",
            hint="look at the robot, then start again",
        )


def confirm_together(
    moves: Moves, *, who: str = "", yes: bool = False, console: Console | None = None
) -> Together:
    """Confirm the motion of every real robot now, and return the confirmation.

    Args:
        moves: Of the series or fleet.
        who: Recorded; by default the user of this process.
        yes: Confirm without asking.
        console: Where the names are typed; by default the terminal of this process.

    Raises:
        SpecError: The file does not name a robot with its address.
        NotConfirmed: A name was not typed.
    """
    digests = tuple(_digests_of(one) for one in moves.real())  # before the facts are read
    _answers(moves, who=who, yes=yes, console=console, purpose="move")
    how = "--yes" if yes else TYPED
    return Together(moves.file, dict(moves.named), how, who or this_user(), digests)


def arm(
    moves: Moves,
    folder: Path,
    *,
    station: Path | None = None,
    who: str = "",
    yes: bool = False,
    console: Console | None = None,
) -> Document | None:
    """Confirm the motions of a schedule from now on, and record that.

    Args:
        moves: Of the schedule.
        folder: Of its state.
        station: In place of the one the schedule names.
        who: Recorded; by default the user of this process.
        yes: Confirm without asking.
        console: Where the names are typed; by default the terminal of this process.

    Returns:
        The record; None if no real robot would move.

    Raises:
        SpecError: The file does not name a robot with its address.
        NotConfirmed: A name was not typed.
    """
    facts = _facts(moves)
    answers = _answers(moves, who=who, yes=yes, console=console, purpose="arm", facts=facts)
    if not answers:
        return None
    first = next(iter(answers.values()))
    document = {
        "hil_armed": FORMAT,
        "file": str(moves.file.resolve()),
        "station": str(station.resolve()) if station else None,
        "how": first["how"],
        "by": first["by"],
        "at": utc_now(),
        "robots": {robot: answer["address"] for robot, answer in answers.items()},
        "digests": _digests(moves),
        "facts": [one.to_dict() for one in facts],
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_replacing(folder / ARMED_FILE, json_document(document))
    return document


def require_armed(moves: Moves, folder: Path) -> Confirm | None:
    """Return the confirmation of a schedule that is armed; None if no real robot would move.

    It holds for as long as the schedule is armed: record and files are read again before each
    motion.

    Raises:
        SpecError: The file does not name a robot with its address.
        NotConfirmed: The schedule is not armed, or something has changed since.
        DataError: The record is damaged.
    """
    real = moves.real()
    confirm = Rechecked(partial(_armed, moves, folder))
    for one in real:
        confirm.admit(one.spec.robot, moves.named[one.spec.robot])
    return confirm if real else None


def _armed(moves: Moves, folder: Path, robot: str) -> Granted:
    """Return what the record of a schedule grants a robot now."""
    hint = (
        f"look at the robot, then: hil schedule arm {moves.file}; restart the schedule if it is "
        "running"
    )
    document = read_armed(folder)
    if document is None or robot not in document["robots"]:
        raise NotConfirmed(
            f"{moves.file} moves {robot} at {moves.named.get(robot, UNKNOWN)}, a real robot, and "
            "is not armed",
            hint=hint,
        )
    if changed := changed_since(document, moves):
        raise NotConfirmed(
            f"{moves.file} was armed on {document['at'][:16]} UTC by {document['by']}; changed "
            f"since: {', '.join(changed)}",
            hint=hint,
        )
    return Granted(
        "armed",
        document["by"],
        {"robot": robot, "address": document["robots"][robot]},
        {"armed_at": document["at"], "armed_how": document["how"]},
    )


def read_armed(folder: Path) -> Document | None:
    """Return the record of an armed schedule; None if it is not armed.

    Raises:
        DataError: The record is damaged.
    """
    path = folder / ARMED_FILE
    if not path.exists():
        return None
    document = read_json(path)
    texts = all(isinstance(document.get(key), str) for key in ("how", "by", "at"))
    maps = all(isinstance(document.get(key), dict) for key in ("robots", "digests"))
    if document.get("hil_armed") != FORMAT or not (texts and maps):
        raise DataError(f"{path} is not the record of an armed schedule", hint="arm it again")
    return document


def changed_since(document: Mapping[str, Any], moves: Moves) -> list[str]:
    """Return a short text per difference since a schedule was armed."""
    then, now = document["digests"], _digests(moves)
    return sorted(what for what in then.keys() | now.keys() if then.get(what) != now.get(what))


def _answers(
    moves: Moves,
    *,
    who: str,
    yes: bool,
    console: Console | None,
    purpose: str,
    facts: Sequence[MotionFacts] = (),
) -> dict[str, Document]:
    """Ask for the name of every real robot; return `how`, `by` and `address` of each."""
    by = who or this_user()
    if not (real := moves.real()):
        return {}
    robots = {one.spec.robot: moves.named[one.spec.robot] for one in real}
    if yes:
        return {name: {"how": "--yes", "by": by, "address": at} for name, at in robots.items()}
    console = console or Console()
    if not console.present:
        which = ", ".join(f"{name} at {at}" for name, at in robots.items())
        raise NotConfirmed(
            f"{which}: real robots, and their motion cannot be confirmed: no terminal is attached",
            hint="start it in a terminal; in a script confirm with --yes",
        )
    _show(console, facts or _facts(moves))
    for name in robots:
        console.forget_typed()
        console.say(ask=f"type {name} to {purpose}, Enter to leave all where they are: ")
        if typed_line(console) != name:
            raise NotConfirmed(
                f"{name} was not confirmed; nothing has moved", hint=f"start again and type {name}"
            )
    return {name: {"how": TYPED, "by": by, "address": at} for name, at in robots.items()}


def _facts(moves: Moves) -> list[MotionFacts]:
    """Return the facts of every motion of a real robot, planned without connecting to it."""
    facts = []
    for experiment in moves.real():
        with planned(experiment) as (robot, plan, _):
            facts.append(motion_facts(experiment, robot, plan))
    return facts


def _show(console: Console, facts: Iterable[MotionFacts]) -> None:
    console.show(["", "Real robots will move without a prompt before each motion:"])
    checklist: dict[str, None] = {}
    for one in facts:
        console.show([*(f"  {line}" for line in one.lines()), ""])
        checklist |= dict.fromkeys(one.checklist)
    console.show([NOT_INCLUDED, ""])
    if checklist:
        must = [f"  [ ] {item}" for item in checklist]
        console.show(["The names also confirm that:", *must])


def _digests(moves: Moves) -> dict[str, str]:
    """Return the digest of each document that decides where a robot moves, by its name."""
    try:
        content = moves.file.read_bytes()
    except OSError as error:
        raise SpecError(
            f"{moves.file}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None
    digests = {"schedule file": hashlib.sha256(content).hexdigest()}
    for place, one in moves.experiments.items():
        of_one = _digests_of(one)
        digests[f"experiment {place}"] = of_one.pop("experiment")
        digests |= of_one
    return digests


def _digests_of(experiment: Experiment) -> dict[str, str]:
    """Return the digests of what decides where an experiment moves its robot."""
    robot, entry = experiment.spec.robot, experiment.robot
    arm_file = model_sha256(entry.model)  # as this process uses it: it is parsed once
    return {
        "experiment": spec_hash(experiment.spec),
        _entry(robot): digest_of(entry.model_dump(mode="json")),
        **({f"arm description of {robot}": arm_file} if arm_file else {}),
    }


def _entry(robot: str) -> str:
    return f"entry of {robot} in the station"
