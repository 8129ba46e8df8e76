"""Single confirmation of motion for all real robots of a schedule, series or fleet file.

A schedule, a series and a fleet run experiments in sequence or in parallel. Each schedule, series
or fleet file names every real robot with its address (`robots: {ur5: 192.168.0.5}`). The robots of
a series or a fleet are confirmed together at the start (`confirm_together`). The motions of a
schedule are confirmed in advance, by arming the schedule (`arm`). The arming record beside the
ledger of the schedule stays valid until the schedule file, an experiment, the station entry of the
robot, or the description of its arm changes. Each run of a schedule checks the arming record again
before the robot moves, because files may change while the schedule is running.
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
    "Planned without a connection: the motion from the present pose to the first pose is not "
    "included."
)


@dataclass(frozen=True, slots=True)
class Moves:
    """Motions that a schedule, a series or a fleet executes.

    Attributes:
        file: File that names the robots and their addresses.
        named: Address of each real robot according to the file, by name of the robot.
        experiments: Experiments of the file, by position in the file (`probe`, `series.0`).
    """

    file: Path
    named: Mapping[str, str]
    experiments: Mapping[str, Experiment]

    def real(self) -> tuple[Experiment, ...]:
        """Return the experiments with real robots, without connecting to the robots.

        Raises:
            SpecError: The file does not name one of the real robots or contains a different address
                for the robot, or a driver does not report an address.
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
                continue  # the run reports the error and moves no unconfirmed robot
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
    """Confirmation of motion that is checked again before each motion; implements `Confirm`.

    Attributes:
        granted: Function that returns the confirmation for a robot, or raises `NotConfirmed`.
    """

    granted: Callable[[str], Granted]

    def admit(self, robot: str, address: str) -> None:
        """See `Confirm`."""
        self.granted(robot).admit(robot, address)

    def __call__(self, facts: MotionFacts, meanwhile: Callable[[], object]) -> Document:
        """See `Confirm`; this method is called after planning, so changed files are detected."""
        return self.granted(facts.robot)(facts, meanwhile)


@dataclass(frozen=True, slots=True)
class Together:
    """Confirmation of all motions of a series or a fleet, given when the series or fleet starts.

    Attributes:
        file: File that names the robots and their addresses.
        named: Address of each real robot according to the file, by name of the robot.
        how: Method of the confirmation, recorded with each run: `typed` or `--yes`.
        by: Name of the user who confirmed the motions.
        digests: Digests of the documents of each experiment that moves a real robot.
    """

    file: Path
    named: Mapping[str, str]
    how: str
    by: str
    digests: tuple[Mapping[str, str], ...]

    def begin(self, experiment: Experiment) -> Confirm:
        """Return the confirmation of an experiment, valid while its documents do not change."""
        return Rechecked(partial(self._granted, experiment))

    def resume(self, robot: str, run: Path) -> Confirm:
        """Return the confirmation for resuming a run that was started and confirmed earlier.

        A typed robot name confirms only new runs; `--yes` also confirms resumed runs, for all
        robots that the file names.
        """
        if self.how != TYPED and robot in self.named:
            return self._at(robot)
        return Unconfirmed(hint=f"resume this run separately: hil resume {run}")

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
            hint="inspect the robot, then start again",
        )


def confirm_together(
    moves: Moves, *, who: str = "", yes: bool = False, console: Console | None = None
) -> Together:
    """Ask for confirmation of the motion of every real robot, and return the confirmation.

    Args:
        moves: Motions of the series or fleet.
        who: Name of the user who confirms, for the record; by default the user of this process.
        yes: Whether the motions are confirmed without asking the user.
        console: Console at which the names are typed; by default the terminal of this process.

    Raises:
        SpecError: The file does not name one of the real robots with its address.
        NotConfirmed: The user did not type the name of a robot.
    """
    digests = tuple(_digests_of(one) for one in moves.real())  # before the operator reads the facts
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
    """Arm a schedule: confirm its motions, and write the record of the confirmation.

    Args:
        moves: Motions of the schedule that are confirmed.
        folder: Folder with the state of the schedule.
        station: Station file that replaces the one in the schedule.
        who: Name of the user who confirms, for the record; by default the user of this process.
        yes: Whether the motions are confirmed without asking the user.
        console: Console at which the names are typed; by default the terminal of this process.

    Returns:
        Record of the confirmation; None if the schedule moves no real robot.

    Raises:
        SpecError: The file does not name one of the real robots with its address.
        NotConfirmed: The user did not type the name of a robot.
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
    """Return the confirmation of an armed schedule; None if the schedule moves no real robot.

    The confirmation is valid while the schedule is armed: the arming record and the confirmed files
    are read again before each motion.

    Raises:
        SpecError: The file does not name one of the real robots with its address.
        NotConfirmed: The schedule is not armed, or one of its files was changed after arming.
        DataError: The arming record is damaged.
    """
    real = moves.real()
    confirm = Rechecked(partial(_armed, moves, folder))
    for one in real:
        confirm.admit(one.spec.robot, moves.named[one.spec.robot])
    return confirm if real else None


def _armed(moves: Moves, folder: Path, robot: str) -> Granted:
    """Return the present confirmation for a robot, from the arming record of its schedule."""
    hint = (
        f"inspect the robot, then: hil schedule arm {moves.file}; restart the schedule if it is "
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
    """Return the arming record of a schedule; None if the schedule is not armed.

    Raises:
        DataError: The arming record is damaged.
    """
    path = folder / ARMED_FILE
    if not path.exists():
        return None
    document = read_json(path)
    texts = all(isinstance(document.get(key), str) for key in ("how", "by", "at"))
    maps = all(isinstance(document.get(key), dict) for key in ("robots", "digests"))
    if document.get("hil_armed") != FORMAT or not (texts and maps):
        raise DataError(
            f"{path} is not the record of an armed schedule", hint="arm the schedule again"
        )
    return document


def changed_since(document: Mapping[str, Any], moves: Moves) -> list[str]:
    """Return the names of the documents that changed after a schedule was armed."""
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
    """Ask for the name of every real robot; return `how`, `by` and `address` of each robot."""
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
            f"the motion of real robots cannot be confirmed ({which}): no terminal is attached",
            hint="start the command in a terminal; in a script, confirm with --yes",
        )
    _show(console, facts or _facts(moves))
    for name in robots:
        console.forget_typed()
        console.say(ask=f"type {name} to {purpose} this robot, or press Enter to cancel: ")
        if typed_line(console) != name:
            raise NotConfirmed(
                f"{name} was not confirmed; nothing has moved", hint=f"start again and type {name}"
            )
    return {name: {"how": TYPED, "by": by, "address": at} for name, at in robots.items()}


def _facts(moves: Moves) -> list[MotionFacts]:
    """Return the facts of every motion of a real robot, planned without a robot connection."""
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
        console.show(["Typing the names also confirms that:", *must])


def _digests(moves: Moves) -> dict[str, str]:
    """Return the digest of each document that determines the motion of a real robot, by name."""
    try:
        content = moves.file.read_bytes()
    except OSError as error:
        raise SpecError(
            f"{moves.file}: cannot be read: {error.strerror}",
            hint="check that the file exists and is readable",
        ) from None
    digests = {"schedule file": hashlib.sha256(content).hexdigest()}
    for place, one in moves.experiments.items():
        of_one = _digests_of(one)
        digests[f"experiment {place}"] = of_one.pop("experiment")
        digests |= of_one
    return digests


def _digests_of(experiment: Experiment) -> dict[str, str]:
    """Return the digests of the documents that determine the motion of one experiment."""
    robot, entry = experiment.spec.robot, experiment.robot
    arm_file = model_sha256(entry.model)  # of the version that this process has loaded
    return {
        "experiment": spec_hash(experiment.spec),
        _entry(robot): digest_of(entry.model_dump(mode="json")),
        **({f"arm description of {robot}": arm_file} if arm_file else {}),
    }


def _entry(robot: str) -> str:
    return f"entry of {robot} in the station"
