"""Standard output and error as a command line needs them: a reader that leaves is no error."""

from __future__ import annotations

import os
import sys
from typing import Any, TextIO, cast

from hil.core import utf8_text


class Stream:
    """A text stream that survives what is at its other end.

    When the reader of a pipe has gone (`hil runs | head`), the rest is dropped and the command
    ends as it would have ended. Every other refusal of the system, such as a full disk, is raised
    once; what is still buffered goes nowhere, so that leaving Python does not fail over it again.

    Args:
        stream: What is wrapped.
        silent: Drop every failure: where errors are told, there is nowhere else to tell them.
    """

    def __init__(self, stream: TextIO, *, silent: bool = False) -> None:
        self._stream = stream
        self._silent = silent
        self.used = False
        self.gone = False  # True once nobody reads any more, or nothing can be written

    def write(self, text: str) -> int:
        """Write text; see the class for what fails."""
        if text == "":  # a probe of typer's, which would take a failure for an answer
            return 0
        self.used = True
        try:
            return self._stream.write(utf8_text(text))
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Flush; see the class for what fails."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _give_up(self, error: OSError) -> None:
        self.gone = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        if not (self._silent or isinstance(error, BrokenPipeError)):
            raise OSError(error.errno, error.strerror, "standard output") from error


def guard_streams() -> Stream | None:
    """Wrap both standard streams for the rest of this process.

    Returns:
        Standard output; None when the process was started without one.
    """
    if sys.stderr is not None:
        sys.stderr = cast(TextIO, Stream(sys.stderr, silent=True))
    if sys.stdout is None:
        return None
    out = Stream(sys.stdout)
    sys.stdout = cast(TextIO, out)
    return out
