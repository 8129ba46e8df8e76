"""A C compiler: programs are compiled and run before anybody relies on them.

Also how much stack a program takes at most, which a task on a controller has to be given.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hil.core import FitError, PluginError

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
PORTABLE = "-O2"
COMPILERS = ("cc", "gcc", "clang")
LONGEST_S = 120.0
NOTHING = "int main(void) { return 0; }\n"


def compiler() -> tuple[str, ...] | None:
    """How the compiler is called: `CC` of the environment, or the first of the usual names.

    Raises:
        PluginError: `CC` names one that is not there.
    """
    if named := shlex.split(os.environ.get("CC", "")):
        if (path := shutil.which(named[0])) is None:
            raise PluginError(
                f"CC={os.environ['CC']} names no program that can be run",
                hint="name a C compiler that is installed, or unset CC to take the usual one",
            )
        return (path, *named[1:])
    found = next((path for name in COMPILERS if (path := shutil.which(name))), None)
    return None if found is None else (found,)


def require_compiler() -> tuple[str, ...]:
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


def compile_program(
    folder: Path, files: Sequence[str], out: str, flags: Sequence[str] = (PORTABLE,)
) -> Path:
    """Compile and link files of a folder, which is searched for headers as well.

    Raises:
        FitError: The compiler refuses, which is a fault of the export.
        PluginError: There is no compiler, or none that makes programs at all.
    """
    done = _compiled(folder, files, out, (*STRICT, *flags, "-I."))
    if done.returncode or not (folder / out).is_file():
        _require_works(flags)
        raise FitError(
            f"the C program does not compile: {done.stderr.strip()[:500]}",
            hint="this is a fault of hil's export: please report it with the model's folder",
        )
    return folder / out


def _compiled(
    folder: Path, files: Sequence[str], out: str, flags: Sequence[str]
) -> subprocess.CompletedProcess[str]:
    return _run([*require_compiler(), *flags, *files, "-lm", "-o", out], folder)


def _run(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(  # noqa: S603  # a compiler, and what it has just made
            command, cwd=folder, capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise FitError(
            f"{command[0]} cannot be run: {error}",
            hint="install gcc or clang, or name a compiler: CC=…; --unchecked leaves the check out",
        ) from error


def _require_works(flags: Sequence[str]) -> None:
    """Refuse a compiler that cannot even make a program that does nothing."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.c").write_text(NOTHING, "utf-8")
        done = _compiled(folder, ("a.c",), "a.out", flags)
        if done.returncode == 0 and (folder / "a.out").is_file():
            return
    raise PluginError(
        f"{shlex.join(require_compiler())} does not compile: {done.stderr.strip()[:300]}",
        hint="name a C compiler that makes programs for this machine with CC=…",
    )


def run_self_test(folder: Path, program: Path) -> str:
    """Return how well a self-test agrees, and on a line of its own the size of the state.

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
    return _run([*require_compiler(), *arguments], folder)


FRAMES = "-fstack-usage"


def stack_bytes(folder: Path, prefix: str, flags: Sequence[str] = (PORTABLE,)) -> int | None:
    """Bytes that any call of the program takes, without what `math.h` takes of its own.

    No function of a program calls itself or is called through a pointer, so the frames of those
    inside and the largest of those outside add up to at least what any call can need.

    Args:
        folder: Holds the program.
        prefix: Of its files.
        flags: Of the compiler.

    Returns:
        None where the compiler does not tell, or a frame has no largest size.

    Raises:
        PluginError: There is no compiler.
    """
    compiled = ("-std=c99", *flags, FRAMES, "-c", f"{prefix}.c", "-o", "stack.o")
    if asked(compiled, folder).returncode:
        return None
    outside, inside = [0], [0]
    for file in folder.glob("*.su"):
        for line in file.read_text("utf-8").splitlines():
            place, size, kind = line.split("\t")
            if kind == "dynamic":
                return None
            function = place.rpartition(":")[2]
            (outside if function in _called(prefix) else inside).append(int(size))
    return max(outside) + sum(inside) or None


def _called(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{name}" for name in ("step", "reset", "set_load"))


def size_note(folder: Path, prefix: str, state: str) -> str:
    """For people: stack and state, and what they were measured with.

    Args:
        folder: Holds the program.
        prefix: Of its files.
        state: What the self-test says of the state.
    """
    stack = stack_bytes(folder, prefix)
    frames = "" if stack is None else f"at most {stack} bytes of stack beside math.h's own, "
    told = asked(("--version",), folder).stdout.partition("\n")[0]
    machine = asked(("-dumpmachine",), folder).stdout.strip()
    return f"{frames}{state} ({', '.join(filter(None, (told, PORTABLE, machine)))})"
