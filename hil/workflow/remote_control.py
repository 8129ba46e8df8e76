"""Pausing, stopping and answering a live run from another process.

A request is a file in `RUN/.control/`, which appears whole. The folder exists while the run takes
requests (`Control`); the run removes them and logs what it did. A request names the holder of the
run's lock, so that one that a crash has left is not obeyed by a later attempt. The requesting side
(`pause_run`, `stop_run`, `answer_run`) waits until the live view shows the effect.
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
    """The prompt of a run, as it was read.

    Attributes:
        text: The whole text.
        asked: Number of the prompt in this attempt, from 1; 0 if the run does not count.
        holder: `id` of the lock of the run: a resumed run counts anew.
    """

    text: str
    asked: int
    holder: str


What = Literal["pause", "resume", "stop", "answer"]


@dataclass(frozen=True, slots=True)
class Reaction:
    """The state of a run after a request.

    Attributes:
        run: The run directory.
        asked: `pause`, `resume`, `stop` or `answer`.
        state: State of the run; `completed`, `stopped`, … if it has ended.
        reason: Why it is in that state.
        step, steps: Index of the present step, and number of steps.
    """

    run: str
    asked: What
    state: str
    reason: str
    step: int
    steps: int

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil pause --json` and the like."""
        return asdict(self)


def pause_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Pause a run at its next checkpoint.

    Args:
        run: The run directory.
        who: Name of the user; recorded.
        reason: Why; recorded.
        wait_s: How long to wait until it has paused [s]; 0 does not wait.

    Raises:
        DataError: The run is not live, or its motion is over.
        RobotTimeout: It has not paused in that time; the request stands.
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
    """Drop a request as soon as the run takes requests; one that has just begun does not yet."""
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
    """Return the `id` of the process that holds a run.

    Raises:
        DataError: The run is not live, or its motion is over.
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
    """Return whether the run has ended, or its process has died."""
    if not is_live(run):
        return True
    return view.get("state") == "done" and RunDirectory(run).stop is not None


def _too_late(run: Path, what: What, file: Path, wait_s: float) -> RobotTimeout:
    """Withdraw a request that was not obeyed in time; return the error, also if it was taken."""
    try:
        file.unlink()
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


def _reaction(run: Path, what: What, view: View) -> Reaction:
    if _is_over(run, view):
        state, reason = ending(run)
    else:
        state, reason = str(view.get("state", "")), str(view.get("reason", ""))
    standing = standing_in(view)
    return Reaction(str(run), what, state, reason, standing.step, standing.steps)


def resume_live_run(run: Path, *, who: str, wait_s: float = WAIT_S) -> Reaction:
    """End the pause of a live run; see `pause_run`. An interlock may hold it all the same."""
    return _ask(run, "resume", who, wait_s, lambda view: view.get("state") != "paused")


def stop_run(run: Path, *, who: str, reason: str = "", wait_s: float = WAIT_S) -> Reaction:
    """Stop a run now, and wait until it has written its stop document; see `pause_run`."""
    return _ask(run, "stop", who, wait_s, lambda view: False, reason)


def question_of(run: Path) -> Question:
    """Return the present prompt of a run.

    Raises:
        DataError: It has none, or is not live.
    """
    holder = _require_moving(run)
    question = _question_in(read_live(run))
    # Another holder: it is the prompt of an attempt that died. No holder: of an older version.
    if not question.text or question.holder not in ("", holder):
        raise DataError(f"{run} asks nothing at the moment", hint=f"follow it: hil watch {run}")
    return question


def _question_in(view: View) -> Question:
    """Return the prompt of a live view, of the attempt that has written it."""
    standing = standing_in(view)
    return Question(standing.prompt, standing.asked, str(view.get("holder", "")))


def answer_run(
    run: Path, yes: bool, *, who: str, asked: Question | None = None, wait_s: float = WAIT_S
) -> Reaction:
    """Answer the prompt of a run; see `pause_run`.

    Args:
        run: The run directory.
        yes: Whether it is done; a no stops the run.
        who: Name of the user; recorded.
        asked: The prompt that is answered, and no later one; by default the present one.
        wait_s: How long to wait until the run has taken the answer [s]; 0 does not wait.

    Raises:
        DataError: It has no prompt, or is not live.
    """
    question = asked or question_of(run)

    def obeyed(view: View) -> bool:
        return yes and _question_in(view) != question  # a no ends the run

    return _ask(run, "answer", who, wait_s, obeyed, "", question, yes)


def ending(run: Path) -> tuple[str, str]:
    """Return how a run that is not live ended, and why.

    Raises:
        DataError: Its documents are damaged.
    """
    directory = RunDirectory.open(run)
    return directory.status, str((directory.stop or {}).get("reason", ""))


@contextlib.contextmanager
def hold_attempt(run: Path) -> Iterator[None]:
    """Hold a run while inside, and accept requests from the first moment: a stop, above all.

    They wait until `Control` takes them. The live view that an attempt has left that died, and the
    requests to it, are removed.

    Raises:
        DataError, RecordingError: See `hil.core.lock_file.hold_run`.
    """
    with hold_run(run):
        forget_live(run)
        with contextlib.suppress(OSError):  # on a full disk the run takes no requests
            (run / FOLDER).mkdir(exist_ok=True)
        try:
            yield
        finally:
            shutil.rmtree(run / FOLDER, ignore_errors=True)


MOST_BYTES = 64 * 1024


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """A request to a run.

    Attributes:
        what: What to do.
        who: Name of the user.
        holder: `id` of the lock of the run.
        reason: Why, in words.
        prompt: For `answer`: the whole text of the prompt.
        yes: For `answer`: whether it is done.
        asked: For `answer`: number of the prompt (`Standing.asked`); 0 if only its text is known.
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
        """User and reason, for example `asked by anna: lunch`."""
        return f"asked by {plain(self.who)}" + (f": {plain(self.reason)}" if self.reason else "")


def drop(run: Path, request: ControlRequest) -> Path:
    """Write a request; return its file, which is gone as soon as the run has taken it.

    Raises:
        DataError: The run does not take requests.
        RecordingError: Its directory cannot be written to.
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
            f"{run} does not listen at the moment",
            hint="it is not moving yet, or not any more; see: hil watch",
        ) from error
    except OSError as error:
        raise RecordingError(
            f"cannot write to {run}: {error.strerror or error}",
            hint="ask as the user who started the run, or see who may write there",
        ) from error
    return path


EVERY_S = 0.05
"""Time between two looks at the folder of requests [s]."""


class Steered(Protocol):
    """The engine, as requests need it. Every member is safe from any thread."""

    def request_pause(self, reason: str) -> None:
        """Pause at the next checkpoint."""

    def request_resume(self, by: str) -> None:
        """End a pause that was requested."""

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Stop now."""


@runtime_checkable
class Answerable(Protocol):
    """A prompt that also takes answers from elsewhere; see `hil.workflow.operator`."""

    def accept_remote_answers(self, run: Path | None) -> None:
        """Accept answers to this run's prompts from now on; None ends that."""

    def answer(self, yes: bool, who: str, prompt: str, prompt_number: int = 0) -> str:
        """Take an answer; return why it was not taken, or nothing."""


FOLDER = ".control"


class Control:
    """Takes the requests to a run while it is open, on a thread of its own; a context manager.

    Args:
        run: The run directory, held by this process.
        engine: Paused, resumed and stopped by requests.
        event: Logs every request (`Sink.event`).
        prompt: The engine's prompt; gets the answers if it takes any.
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
        """Begin to take requests, first those from before, since `hold_attempt`."""
        holder = run_holder(self._run)
        self._holder = holder.id if holder else ""
        with contextlib.suppress(OSError):  # on a full disk the run takes no requests
            (self._run / FOLDER).mkdir(exist_ok=True)
        if self._prompt is not None:
            self._prompt.accept_remote_answers(self._run)
        self._look()  # the arm must not begin to move while a stop waits
        self._thread.start()

    def close(self) -> None:
        """Take no more requests. Idempotent."""
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
                continue  # it could not be removed, or was withdrawn
            except Exception as error:  # the next request may be a stop
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
        """Do what is requested; return why it was not done, or nothing."""
        if request.what == "pause":
            self._engine.request_pause(request.words)
        elif request.what == "resume":
            self._engine.request_resume(plain(request.who))
        elif request.what == "stop":
            self._engine.request_stop(f"stop {request.words}")
        elif self._prompt is None:
            return "the run takes no answers from elsewhere"
        else:
            who = plain(request.who)
            return self._prompt.answer(request.yes, who, request.prompt, request.asked)
        return ""

    def _note(self, **details: Any) -> None:
        with contextlib.suppress(HilError):  # a log that has failed ends the run by itself
            self._event("control", **details)


def waiting(run: Path) -> list[Path]:
    """Return the requests that wait, oldest first."""
    try:
        names = sorted(os.listdir(run / FOLDER))
    except OSError:
        return []
    return [run / FOLDER / name for name in names if not name.startswith(".")]


def take(path: Path) -> ControlRequest | str:
    """Remove a request; return it, or what is wrong with it.

    Raises:
        OSError: It cannot be read or removed, so it must not be obeyed: it would be again and
            again.
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
        raise ValueError("it does not say what to do")
    return ControlRequest(**dict(_values(document)))


_KINDS: dict[str, type] = {"yes": bool, "asked": int}
"""Types of the fields that are no texts."""


def _values(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for field in fields(ControlRequest):
        value, kind = document.get(field.name), _KINDS.get(field.name, str)
        if value is None and field.name not in ("who", "holder"):
            continue
        if type(value) is not kind:  # a bool is an int as well
            raise ValueError(f"{field.name} is not a {kind.__name__}")
        yield field.name, value
