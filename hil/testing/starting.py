"""How mocks that are processes of their own are started for tests, and what that needs."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hil.core import PluginError, plugins

READY_WITHIN_S = 60.0
_LAST_WORDS_S = 5.0


def require_extras(what: str, *extras: str) -> None:
    """Check that what a mock needs is installed; nothing is imported.

    Raises:
        PluginError: It is not; the hint says what to install.
    """
    missing = [module for extra in extras for module in plugins.absent_modules(extra)]
    if missing:
        raise plugins.not_installed(what, missing, *extras)


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """A temporary folder with a short path: that of a socket has 107 bytes at most."""
    with tempfile.TemporaryDirectory(prefix="hil-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@contextlib.contextmanager
def running(
    name: str, options: Mapping[str, Any], folder: Path
) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Start a mock, wait until it is ready, end it; gives the process and its journal.

    Args:
        name: Of the mock, in the entry points `hil.mocks`.
        options: Of its command line, with `_` for `-`; `faults` may be a list.
        folder: For its files.

    Raises:
        PluginError: It does not start; the message is what it said.
    """
    options = {"journal": folder / "journal.jsonl", **options}
    command = [sys.executable, "-m", "hil.testing.mock_child", name, *_arguments(options, folder)]
    said = folder / "stderr"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with (
        said.open("w", encoding="utf-8") as errors,
        subprocess.Popen(  # noqa: S603 - this interpreter, our own module
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the tests; they end their mocks themselves
        ) as process,
    ):
        try:
            _wait_until_ready(name, process, said)
            yield process, Path(options["journal"])
        finally:
            if process.poll() is None:
                process.kill()


def _arguments(options: Mapping[str, Any], folder: Path) -> Iterator[str]:
    for key, value in options.items():
        flag = "--" + key.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            yield flag
        elif key == "faults" and not isinstance(value, str | Path):
            file = folder / "faults.yaml"  # JSON is YAML
            file.write_text(json.dumps(list(value)), "utf-8")
            yield f"{flag}={file}"
        elif isinstance(value, list | tuple):
            yield from (flag, *map(str, value))
        else:
            yield f"{flag}={value}"


def _wait_until_ready(name: str, process: subprocess.Popen[str], said: Path) -> None:
    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], READY_WITHIN_S)
    if readable and process.stdout.readline().startswith("ready"):
        return
    if readable:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_LAST_WORDS_S)  # its output ends before it does
    _, _, last = said.read_text("utf-8").strip().rpartition(": error: ")  # after its usage
    why = last or f"it says nothing for {READY_WITHIN_S:g} s"
    raise PluginError(f"the {name} mock does not start: {why}")
