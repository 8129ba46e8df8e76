"""The process a mock lives in while tests use it: `python -m hil.testing.mock_child NAME …`.

It ends when its standard input does: however the tests die, they leave no mock behind.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence

from hil.core import HilError, plugins

STANDARD_INPUT = 0


def main(arguments: Sequence[str]) -> int:
    """Be the mock that the first argument names; returns the exit code."""
    name, *own = arguments
    threading.Thread(target=_end_with_the_input, name="hil-alone", daemon=True).start()
    try:
        return int(plugins.load("hil.mocks", name)().serve(own))
    except HilError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return error.exit_code


def _end_with_the_input() -> None:
    while os.read(STANDARD_INPUT, 1024):
        pass
    # To the main thread itself: a signal that another one hears does not wake it.
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
