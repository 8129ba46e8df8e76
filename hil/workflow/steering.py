"""Pausing, stopping and answering a live run from another process, and seeing that it obeyed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hil.core import DataError, RobotTimeout, is_live, plain, run_holder
from hil.recording import RunDirectory
from hil.workflow.control_files import ControlRequest, What, drop
from hil.workflow.live_state import read_live, standing_in

LOOK_EVERY_S = 0.1
WAIT_S = 60.0

View = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Question:
    """What a run asks, as it was read.

    Attributes:
        text: The whole text.
        asked: Its number among the prompts of the run, from 1; 0 where the run does not count.
        holder: `id` of the lock of the run: a run that was gone on with counts anew.
    """

    text: str
    asked: int
    holder: str


@dataclass(frozen=True, slots=True)
class Reaction:
    """What came of a request.

    Attributes:
        run: The run directory.
        asked: `pause`, `resume`, `stop` or `answer`.
        state: State of the run now; `completed`, `stopped`, … when it has ended.
        reason: Why it is in that state.
        step, steps: Where it is.
    """

    run: str
    asked: What
    state: str
    reason: str
    step: int
    steps: int

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil pause --json` and the like."""
        return asdict(self)


def pause_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Pause a run at its next checkpoint.

    Args:
        run: The run directory.
        who: Who asks; recorded.
        reason: Why; recorded.
        wait_s: How long to wait until it has paused [s]; 0 does not wait.

    Raises:
        DataError: The run is not live, or its motion is over.
        RobotTimeout: It has not paused in that time; the request stands.
    """
    return _ask(run, "pause", who, wait_s, lambda view: view.get("state") == "paused", reason)


def resume_live_run(run: Path, *, who: str, wait_s: float = WAIT_S) -> Reaction:
    """Let a paused live run go on; see `pause_run`. An interlock may hold it all the same."""
    return _ask(run, "resume", who, wait_s, lambda view: view.get("state") != "paused")


def stop_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Stop a run now, and wait until it has written down how it ended; see `pause_run`."""
    return _ask(run, "stop", who, wait_s, lambda view: False, reason)


def question_of(run: Path) -> Question:
    """What a run asks at the moment: text and number of one reading.

    Raises:
        DataError: It asks nothing, or is not live.
    """
    holder = _require_moving(run)
    question = _asked_in(read_live(run))
    # Another holder: an attempt that has died asked that. None: a version that did not say it.
    if not question.text or question.holder not in ("", holder):
        raise DataError(f"{run} asks nothing at the moment", hint=f"follow it: hil watch {run}")
    return question


def answer_run(
    run: Path, yes: bool, *, who: str, asked: Question | None = None, wait_s: float = WAIT_S
) -> Reaction:
    """Answer what a run is asking; see `pause_run`.

    Args:
        run: The run directory.
        yes: Whether it is done; a no stops the run.
        who: Who answers; recorded.
        asked: The question that is answered, and no later one; by default what it asks now.
        wait_s: How long to wait until it has taken notice [s]; 0 does not wait.

    Raises:
        DataError: It asks nothing at the moment, or is not live.
    """
    question = asked or question_of(run)

    def obeyed(view: View) -> bool:
        return yes and _asked_in(view) != question  # a no ends the run

    return _ask(run, "answer", who, wait_s, obeyed, "", question, yes)


def _asked_in(view: View) -> Question:
    """What is asked as a live view has it, in the attempt that has written it."""
    standing = standing_in(view)
    return Question(standing.prompt, standing.asked, str(view.get("holder", "")))


def _ask(
    run: Path,
    what: What,
    who: str,
    wait_s: float,
    obeyed: Callable[[View], bool],
    reason: str = "",
    question: Question | None = None,
    yes: bool = False,
) -> Reaction:
    deadline, seen = time.monotonic() + wait_s, read_live(run)
    about = question or Question("", 0, "")
    asking = ControlRequest(what, who, about.holder, reason, about.text, yes, about.asked)
    request = _hand_over(run, asking, deadline)
    while time.monotonic() < deadline:
        view = read_live(run)
        seen = view or seen  # a run that ends takes its view away
        if not request.exists() and (_is_over(run, view) or obeyed(view)):
            break
        time.sleep(LOOK_EVERY_S)
    else:
        if wait_s > 0:
            raise _too_late(run, what, request, wait_s)
    return _reaction(run, what, seen)


def _hand_over(run: Path, request: ControlRequest, deadline: float) -> Path:
    """Drop a request as soon as the run listens; one that has just begun does not yet."""
    while True:
        holder = _require_moving(run)
        if request.holder not in ("", holder):
            raise DataError(
                f"{run} was gone on with since it has asked that",
                hint=f"follow it: hil watch {run}",
            )
        try:
            return drop(run, replace(request, holder=holder))
        except DataError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(LOOK_EVERY_S)


def _require_moving(run: Path) -> str:
    """The `id` of the process that holds the run.

    Raises:
        DataError: There is none, or the motion is over.
    """
    directory = RunDirectory.open(run)
    holder = run_holder(run)
    if holder is None:
        ended = directory.status
        hint = f"what came of it: hil show {run}"
        if ended != "completed":
            hint = f"go on with it: hil resume {run}"
        raise DataError(f"{run} is not live: it is {ended}", hint=hint)
    if read_live(run).get("state") == "done":
        raise DataError(
            f"the motion of {run} is over already", hint=f"how it goes on: hil watch {run}"
        )
    return holder.id


def _is_over(run: Path, view: View) -> bool:
    """Whether the run has ended, in order or not."""
    if not is_live(run):
        return True
    return view.get("state") == "done" and RunDirectory(run).stop is not None


def _reaction(run: Path, what: What, view: View) -> Reaction:
    if _is_over(run, view):
        state, reason = ending(run)
    else:
        state, reason = str(view.get("state", "")), str(view.get("reason", ""))
    standing = standing_in(view)
    return Reaction(str(run), what, state, reason, standing.step, standing.steps)


def ending(run: Path) -> tuple[str, str]:
    """How a run that is not live ended, and why.

    Raises:
        DataError: Its documents are damaged.
    """
    directory = RunDirectory.open(run)
    return directory.status, str((directory.stop or {}).get("reason", ""))


def _too_late(run: Path, what: What, request: Path, wait_s: float) -> RobotTimeout:
    try:
        request.unlink()
    except FileNotFoundError:
        view = read_live(run)
        now = f"it is {view.get('state', 'silent')}"
        if reason := view.get("reason"):
            now += f" ({plain(reason)})"
        now += ", and pauses at its next checkpoint" if what == "pause" else ""
        return RobotTimeout(
            f"{run} has taken the request to {what}, but not obeyed within {wait_s:g} s: {now}",
            hint=f"follow it: hil watch {run}",
        )
    return RobotTimeout(
        f"{run} does not react: the request to {what} was withdrawn after {wait_s:g} s",
        hint="press Ctrl-C where it was started, or the robot's own stop button",
    )
