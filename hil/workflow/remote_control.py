"""Remote control of a live run: pause, resume, stop or answer the run from a different process.

A request is a file in `RUN/.control/`, which is written completely before it gets its final name.
The folder `.control` exists while the run accepts requests (`Control`); the run removes each
request and logs the requested action. A request contains the `id` of the holder of the run's lock,
so that a later attempt ignores requests that remain after a crash. The requesting functions
(`pause_run`, `stop_run`, `answer_run`) wait until the live view shows the effect of the request.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, get_args, runtime_checkable

from hil.core import (
    DataError,
    HilError,
    RecordingError,
    RobotTimeout,
    fsync_directory,
    hold_run,
    is_live,
    json_document,
    plain,
    run_holder,
)
from hil.recording import RunDirectory
from hil.workflow.live_state import forget_live, read_live, standing_in

LOOK_EVERY_S = 0.1
WAIT_S = 60.0
View = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Question:
    """Prompt of a run, read from the live view.

    Attributes:
        text: Complete text of the prompt, as shown to the operator.
        asked: Number of the prompt in this attempt, from 1; 0 if the run does not number its
            prompts.
        holder: Identifier of the holder of the run's lock, needed because a resumed run restarts
            the numbering of its prompts.
    """

    text: str
    asked: int
    holder: str


What = Literal["pause", "resume", "stop", "answer"]


@dataclass(frozen=True, slots=True)
class Reaction:
    """State of a run after a request.

    Attributes:
        run: Run directory.
        asked: Action that was requested: `pause`, `resume`, `stop` or `answer`.
        state: State of the run; the outcome (`completed`, `stopped`, …) if the run has ended.
        reason: Reason for the state of the run.
        step, steps: Index of the present step, and number of steps of the plan.
    """

    run: str
    asked: What
    state: str
    reason: str
    step: int
    steps: int

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil pause`, `resume`, `stop` and `answer` with `--json`."""
        return asdict(self)


def pause_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Pause a run at its next checkpoint.

    Args:
        run: Run directory.
        who: Name of the user who requests the pause, for the record.
        reason: Reason for the pause, for the record.
        wait_s: Maximum time to wait until the run is paused [s]; 0 returns at once.

    Raises:
        DataError: The run is not live, or its motion has ended.
        RobotTimeout: The run has not paused within `wait_s`. A request that the run has already
            accepted stays in effect; a request that the run has not accepted is withdrawn.
    """
    return _ask(run, "pause", who, wait_s, lambda view: view.get("state") == "paused", reason)


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
    deadline, last = time.monotonic() + wait_s, read_live(run)
    about = question or Question("", 0, "")
    request = ControlRequest(what, who, about.holder, reason, about.text, yes, about.asked)
    file = _hand_over(run, request, deadline)
    while time.monotonic() < deadline:
        view = read_live(run)
        last = view or last  # a run that ends removes its view
        if not file.exists() and (_is_over(run, view) or obeyed(view)):
            break
        time.sleep(LOOK_EVERY_S)
    else:
        if wait_s > 0:
            raise _too_late(run, what, file, wait_s)
    return _reaction(run, what, last)


def _hand_over(run: Path, request: ControlRequest, deadline: float) -> Path:
    """Write a request as soon as the run accepts requests.

    A run that has just begun does not accept requests yet.
    """
    while True:
        holder = _require_moving(run)
        if request.holder not in ("", holder):
            raise DataError(
                f"{run} was resumed after this prompt, so the prompt is no longer open",
                hint=f"follow the run: hil watch {run}",
            )
        try:
            return drop(run, replace(request, holder=holder))
        except DataError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(LOOK_EVERY_S)


def _require_moving(run: Path) -> str:
    """Return the `id` of the process that holds the lock of a run.

    Raises:
        DataError: The run is not live, or its motion has ended.
    """
    directory = RunDirectory.open(run)
    holder = run_holder(run)
    if holder is None:
        ended = directory.status
        hint = f"show the result: hil show {run}"
        if ended != "completed":
            hint = f"continue the run: hil resume {run}"
        raise DataError(f"{run} is not active: its status is {ended}", hint=hint)
    if read_live(run).get("state") == "done":
        raise DataError(
            f"the motion of {run} has ended already", hint=f"follow the run: hil watch {run}"
        )
    return holder.id


def _is_over(run: Path, view: View) -> bool:
    """Return whether a run has ended or the process of the run has died."""
    if not is_live(run):
        return True
    return view.get("state") == "done" and RunDirectory(run).stop is not None


def _too_late(run: Path, what: What, file: Path, wait_s: float) -> RobotTimeout:
    """Withdraw a request that the run did not carry out in time; return the error to raise.

    If the run has already accepted the request, the error contains the present state of the run.
    """
    try:
        file.unlink()
    except FileNotFoundError:
        view = read_live(run)
        now = f"its state is {view.get('state', 'unknown')}"
        if reason := view.get("reason"):
            now += f" ({plain(reason)})"
        now += ", and pauses at its next checkpoint" if what == "pause" else ""
        return RobotTimeout(
            f"{run} has accepted the request to {what}, but has not carried it out within "
            f"{wait_s:g} s: {now}",
            hint=f"follow the run: hil watch {run}",
        )
    return RobotTimeout(
        f"{run} does not react: the request to {what} was withdrawn after {wait_s:g} s",
        hint="press Ctrl-C in the terminal of the run, or press the robot's stop button",
    )


def _reaction(run: Path, what: What, view: View) -> Reaction:
    if _is_over(run, view):
        state, reason = ending(run)
    else:
        state, reason = str(view.get("state", "")), str(view.get("reason", ""))
    standing = standing_in(view)
    return Reaction(str(run), what, state, reason, standing.step, standing.steps)


def resume_live_run(run: Path, *, who: str, wait_s: float = WAIT_S) -> Reaction:
    """End the pause of a live run; see `pause_run` for arguments and errors.

    After the request to resume, an interlock possibly keeps the run paused.
    """
    return _ask(run, "resume", who, wait_s, lambda view: view.get("state") != "paused")


def stop_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Stop a run at once and wait until its stop document is written; see `pause_run`."""
    return _ask(run, "stop", who, wait_s, lambda view: False, reason)


def question_of(run: Path) -> Question:
    """Return the prompt of a run that is open now.

    Raises:
        DataError: The run has no open prompt, or is not live.
    """
    holder = _require_moving(run)
    question = _question_in(read_live(run))
    # A different holder is that of a dead attempt; older versions write no holder.
    if not question.text or question.holder not in ("", holder):
        raise DataError(f"{run} has no open prompt", hint=f"follow the run: hil watch {run}")
    return question


def _question_in(view: View) -> Question:
    """Return the prompt that a live view shows, with the lock holder of its attempt."""
    standing = standing_in(view)
    return Question(standing.prompt, standing.asked, str(view.get("holder", "")))


def answer_run(
    run: Path, yes: bool, *, who: str, asked: Question | None = None, wait_s: float = WAIT_S
) -> Reaction:
    """Answer the prompt of a run; see `pause_run` for further errors.

    Args:
        run: Run directory.
        yes: Whether the requested action is done; False stops the run.
        who: Name of the user who answers, for the record.
        asked: Prompt to answer; the answer is refused if a later prompt is open; by default the
            open prompt.
        wait_s: Maximum time to wait until the run has accepted the answer [s]; 0 returns at once.

    Raises:
        DataError: The run has no open prompt, or is not live.
    """
    question = asked or question_of(run)

    def obeyed(view: View) -> bool:
        return yes and _question_in(view) != question  # "no" ends the run

    return _ask(run, "answer", who, wait_s, obeyed, "", question, yes)


def ending(run: Path) -> tuple[str, str]:
    """Return the final status of a run that is not live, and the reason for this status.

    Raises:
        DataError: The documents of the run are damaged.
    """
    directory = RunDirectory.open(run)
    return directory.status, str((directory.stop or {}).get("reason", ""))


@contextlib.contextmanager
def hold_attempt(run: Path) -> Iterator[None]:
    """Hold the lock of a run within the context, and store requests from the beginning.

    A request, such as a stop, waits in its folder until `Control` reads it. When the context is
    entered, the live view and the requests of an earlier attempt whose process died are removed.

    Raises:
        DataError, RecordingError: The lock is not available, see `hil.core.lock_file.hold_run`.
    """
    with hold_run(run):
        forget_live(run)
        with contextlib.suppress(OSError):  # on a full disk, the run accepts no requests
            (run / FOLDER).mkdir(exist_ok=True)
        try:
            yield
        finally:
            shutil.rmtree(run / FOLDER, ignore_errors=True)


MOST_BYTES = 64 * 1024


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """Request to a run.

    Attributes:
        what: Requested action.
        who: Name of the user who makes the request.
        holder: Identifier of the holder of the run's lock.
        reason: Reason for the request, as text.
        prompt: Complete text of the prompt; only for the action `answer`.
        yes: Whether the prompted action is done; only for the action `answer`.
        asked: Number of the prompt (`Standing.asked`), 0 if only its text is known; only for the
            action `answer`.
    """

    what: What
    who: str
    holder: str
    reason: str = ""
    prompt: str = ""
    yes: bool = False
    asked: int = 0

    @property
    def words(self) -> str:
        """User and reason as text, for example `asked by anna: lunch`."""
        return f"asked by {plain(self.who)}" + (f": {plain(self.reason)}" if self.reason else "")


def drop(run: Path, request: ControlRequest) -> Path:
    """Write the file of a request and return its path; the run removes the file when it accepts.

    Raises:
        DataError: The run does not accept requests.
        RecordingError: The run directory cannot be written to.
    """
    path = run / FOLDER / f"{time.time_ns():020d}-{os.getpid()}.json"
    draft = path.with_name(f".{path.name}")
    try:
        with draft.open("xb") as file:
            file.write(json_document(asdict(request)))
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
        fsync_directory(path.parent)
    except FileNotFoundError as error:
        raise DataError(
            f"{run} does not accept requests at present",
            hint=f"its motion has not begun or has ended: hil watch {run}",
        ) from error
    except OSError as error:
        raise RecordingError(
            f"cannot write to {run}: {error.strerror or error}",
            hint="send the request as the user who started the run, or check the permissions of "
            "the folder",
        ) from error
    return path


EVERY_S = 0.05
"""Time between two checks of the folder of requests [s]."""


class Steered(Protocol):
    """Engine interface for requests to a run; every method may be called from any thread."""

    def request_pause(self, reason: str) -> None:
        """Pause the run at the next checkpoint."""

    def request_resume(self, by: str) -> None:
        """End a requested pause."""

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Stop the run immediately."""


@runtime_checkable
class Answerable(Protocol):
    """Prompt function that also accepts remote answers; see `hil.workflow.operator`."""

    def accept_remote_answers(self, run: Path | None) -> None:
        """Accept answers to the prompts of this run from now on; None stops accepting them."""

    def answer(self, yes: bool, who: str, prompt: str, prompt_number: int = 0) -> str:
        """Accept an answer; return the reason for refusing it, or an empty string."""


FOLDER = ".control"


class Control:
    """Context manager that accepts the requests to a run on a separate thread.

    Args:
        run: Directory of the run, whose lock this process holds.
        engine: Engine of the run, which pauses, resumes and stops on request.
        event: Function that logs every request (`Sink.event`).
        prompt: Prompt function of the engine; receives remote answers if it is `Answerable`.
    """

    def __init__(
        self, run: Path, engine: Steered, event: Callable[..., object], prompt: object = None
    ) -> None:
        self._run = run
        self._engine = engine
        self._event = event
        self._prompt = prompt if isinstance(prompt, Answerable) else None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="hil-control", daemon=True)
        self._holder = ""

    def start(self) -> None:
        """Start accepting requests; requests written since `hold_attempt` are handled first."""
        holder = run_holder(self._run)
        self._holder = holder.id if holder else ""
        with contextlib.suppress(OSError):  # on a full disk, the run accepts no requests
            (self._run / FOLDER).mkdir(exist_ok=True)
        if self._prompt is not None:
            self._prompt.accept_remote_answers(self._run)
        self._look()  # the arm must not start while a stop request is pending
        self._thread.start()

    def close(self) -> None:
        """Stop accepting requests; a second call has no effect."""
        if not self._thread.is_alive():
            return
        self._over.set()
        self._thread.join(1.0)
        if self._prompt is not None:
            self._prompt.accept_remote_answers(None)
        shutil.rmtree(self._run / FOLDER, ignore_errors=True)

    def __enter__(self) -> Control:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _listen(self) -> None:
        while not self._over.wait(EVERY_S):
            self._look()

    def _look(self) -> None:
        for path in waiting(self._run):
            try:
                self._take(path)
            except OSError:
                continue  # the request was not removable, or was withdrawn
            except Exception as error:  # continue: the next request may be a stop
                self._note(what="unknown", problem=repr(error))

    def _take(self, path: Path) -> None:
        request = take(path)
        if isinstance(request, str):
            self._note(what="unknown", problem=request)
        elif request.holder != self._holder:
            self._note(what=request.what, who=request.who, problem="meant for an earlier attempt")
        else:
            problem = self._obey(request)
            details: dict[str, Any] = {"reason": request.reason} if request.reason else {}
            if request.what == "answer":
                details |= {"prompt": request.prompt, "yes": request.yes}
            if problem:
                details |= {"problem": problem}
            self._note(what=request.what, who=request.who, **details)

    def _obey(self, request: ControlRequest) -> str:
        """Carry out a request; return the reason for refusing it, or an empty string."""
        if request.what == "pause":
            self._engine.request_pause(request.words)
        elif request.what == "resume":
            self._engine.request_resume(plain(request.who))
        elif request.what == "stop":
            self._engine.request_stop(f"stop {request.words}")
        elif self._prompt is None:
            return "the run accepts no answers from other processes"
        else:
            who = plain(request.who)
            return self._prompt.answer(request.yes, who, request.prompt, request.asked)
        return ""

    def _note(self, **details: Any) -> None:
        with contextlib.suppress(HilError):  # a failed log ends the run anyway
            self._event("control", **details)


def waiting(run: Path) -> list[Path]:
    """Return the paths of the pending requests, oldest first."""
    try:
        names = sorted(os.listdir(run / FOLDER))
    except OSError:
        return []
    return [run / FOLDER / name for name in names if not name.startswith(".")]


def take(path: Path) -> ControlRequest | str:
    """Remove the file of a request; return the request, or a text that describes its error.

    Raises:
        OSError: The file of the request cannot be read or removed. A request whose file cannot be
            removed must not be obeyed, because it would be obeyed again at the next polling.
    """
    with path.open("rb") as file:
        raw = file.read(MOST_BYTES)
    path.unlink()
    try:
        return _request(json.loads(raw))
    except (ValueError, RecursionError) as error:
        return f"not a request: {plain(error)}"


def _request(document: Any) -> ControlRequest:
    if not isinstance(document, dict) or document.get("what") not in get_args(What):
        raise ValueError("the key `what` is missing or unknown")
    return ControlRequest(**dict(_values(document)))


_KINDS: dict[str, type] = {"yes": bool, "asked": int}
"""Types of the request fields that are not text."""


def _values(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for field in fields(ControlRequest):
        value, kind = document.get(field.name), _KINDS.get(field.name, str)
        if value is None and field.name not in ("who", "holder"):
            continue
        if type(value) is not kind:  # not isinstance: a bool is also an int
            raise ValueError(f"{field.name} is not of type {kind.__name__}")
        yield field.name, value
