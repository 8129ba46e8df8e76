"""A C compiler, where there is one: programs are checked before anybody relies on them."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from hil.errors import FitError, PluginError

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
PORTABLE = "-O2"
COMPILERS = ("cc", "gcc", "clang")
LONGEST_S = 120.0


def compiler() -> str | None:
    """Path of the compiler: `CC` of the environment, or the first of the usual names."""
    names = (os.environ.get("CC", ""), *COMPILERS)
    return next((path for name in names if name and (path := shutil.which(name))), None)


def require_compiler() -> str:
    """The same.

    Raises:
        PluginError: There is none.
    """
    if (found := compiler()) is None:
        raise PluginError(
            "no C compiler was found, so the program cannot be checked against the model",
            hint="install gcc or clang, name one with CC=…, or write it unchecked "
            "(--unchecked) and run its self-test where it is used",
        )
    return found


def built(folder: Path, files: Sequence[str], out: str, flags: Sequence[str] = (PORTABLE,)) -> Path:
    """Compile and link files of a folder.

    Raises:
        FitError: The compiler refuses, which is a fault of the export.
        PluginError: There is no compiler.
    """
    command = [require_compiler(), *STRICT, *flags, *files, "-lm", "-o", out]
    done = _run(command, folder)
    if done.returncode:
        raise FitError(
            f"the C program does not compile: {done.stderr.strip()[:500]}",
            hint="this is a fault of hil's export: please report it with the model's folder",
        )
    return folder / out


def self_tested(folder: Path, program: Path) -> str:
    """What a self-test says: how well it agrees, and on a line of its own the size of the state.

    Raises:
        FitError: It does not pass.
    """
    done = _run([str(program)], folder)
    said = done.stdout.strip()
    if done.returncode:
        raise FitError(
            f"the C program does not agree with the model: {said or f'exit {done.returncode}'}",
            hint="this is a fault of hil's export: please report it with the model's folder",
        )
    return said


def asked(arguments: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """The compiler with these arguments, in a folder; what comes of it is the caller's to judge.

    Raises:
        FitError: It cannot be run.
        PluginError: There is no compiler.
    """
    return _run([require_compiler(), *arguments], folder)


def _run(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(  # noqa: S603  # a compiler, and what it just built
            command, cwd=folder, capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise FitError(f"{command[0]} cannot be run: {error}") from error
