"""A live run listens to other terminals: takes their requests, and writes down what it did."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

from hil.core import HilError, plain, run_holder
from hil.workflow.control_files import FOLDER, ControlRequest, take, waiting

EVERY_S = 0.05
"""Time between two looks at the folder of requests [s]."""


class Steered(Protocol):
    """What requests are passed on to: the engine. Every member is safe from any thread."""

    def request_pause(self, reason: str) -> None:
        """Pause at the next checkpoint."""

    def request_resume(self, by: str) -> None:
        """End a pause that was requested."""

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Stop now."""


@runtime_checkable
class Answerable(Protocol):
    """A prompt that also takes answers from elsewhere; see `hil.workflow.operator`."""

    def listen(self, run: Path | None) -> None:
        """Answers to this run's prompts may come; None ends that."""

    def answer(self, yes: bool, who: str, prompt: str, asked: int = 0) -> str:
        """Take an answer; returns why not, or nothing."""


class Control:
    """Listens while it is open, on a thread of its own; a context manager.

    Args:
        run: The run directory, held by this process.
        engine: Is asked to pause, go on and stop.
        event: Writes down every request (`Sink.event`).
        prompt: The engine's prompt; answers go to it if it takes any.
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
        """Begin to listen, first to what was asked since the run is held (`hold_attempt`)."""
        holder = run_holder(self._run)
        self._holder = holder.id if holder else ""
        with contextlib.suppress(OSError):  # on a full disk nobody can ask, but the run goes on
            (self._run / FOLDER).mkdir(exist_ok=True)
        if self._prompt is not None:
            self._prompt.listen(self._run)
        self._look()  # the arm must not begin to move while a stop waits
        self._thread.start()

    def close(self) -> None:
        """Stop listening. Idempotent."""
        if not self._thread.is_alive():
            return
        self._over.set()
        self._thread.join(1.0)
        if self._prompt is not None:
            self._prompt.listen(None)
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
                continue  # it is still there, or somebody withdrew it
            except Exception as error:  # whatever one request did, the next may be a stop
                self._note(what="unknown", problem=repr(error))

    def _take(self, path: Path) -> None:
        request = take(path)
        if isinstance(request, str):
            self._note(what="unknown", problem=request)
        elif request.holder != self._holder:
            self._note(what=request.what, who=request.who, problem="meant for an earlier attempt")
        else:
            problem = self._obey(request)
            told: dict[str, Any] = {"reason": request.reason} if request.reason else {}
            if request.what == "answer":
                told |= {"prompt": request.prompt, "yes": request.yes}
            if problem:
                told |= {"problem": problem}
            self._note(what=request.what, who=request.who, **told)

    def _obey(self, request: ControlRequest) -> str:
        """Do what is asked; returns why it was not done, or nothing."""
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
