"""Standard output and standard error for a command line; a closed pipe is not an error."""

from __future__ import annotations

import os
import sys
from typing import Any, TextIO, cast

from hil.core import utf8_text


class Stream:
    """Text stream that handles a closed pipe and a full disk without a traceback.

    If the reader of a pipe has closed the pipe (`hil runs | head`), further text is dropped, and
    the command ends with its usual exit code. Any other error of the operating system, such as a
    full disk, is raised one time; buffered text is then dropped, so that the exit of Python does
    not fail again.

    Args:
        stream: Wrapped stream.
        silent: Whether to ignore every error; True for standard error, because there is no other
            stream for reporting its errors.
    """

    def __init__(self, stream: TextIO, *, silent: bool = False) -> None:
        self._stream = stream
        self._silent = silent
        self.used = False
        self.gone = False  # True after the reader has closed the pipe, or writing has failed

    def write(self, text: str) -> int:
        """Write text to the stream; the class describes the handling of errors."""
        if text == "":  # typer writes an empty text to test the stream
            return 0
        self.used = True
        try:
            return self._stream.write(utf8_text(text))
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Flush the stream; the class describes the handling of errors."""
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
    """Wrap standard output and standard error for the rest of this process.

    Returns:
        Standard output; None if the process was started without standard output.
    """
    if sys.stderr is not None:
        sys.stderr = cast(TextIO, Stream(sys.stderr, silent=True))
    if sys.stdout is None:
        return None
    out = Stream(sys.stdout)
    sys.stdout = cast(TextIO, out)
    return out
