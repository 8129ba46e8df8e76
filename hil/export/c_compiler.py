"""Compilation and execution of exported C programs, to check them before use.

The module `c_compiler` also determines the maximum stack size of a program, which is needed for the
configuration of a controller task.
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
    """Return the compiler command: `CC` of the environment, or the first usual name that exists.

    Raises:
        PluginError: The environment variable `CC` names a program that does not exist.
    """
    if named := shlex.split(os.environ.get("CC", "")):
        if (path := shutil.which(named[0])) is None:
            raise PluginError(
                f"CC={os.environ['CC']} is not an executable program",
                hint="set CC to an installed C compiler, or unset CC to use the default compiler",
            )
        return (path, *named[1:])
    found = next((path for name in COMPILERS if (path := shutil.which(name))), None)
    return None if found is None else (found,)


def require_compiler() -> tuple[str, ...]:
    """Return the compiler command; raise if there is no compiler.

    Raises:
        PluginError: There is no compiler.
    """
    if (found := compiler()) is None:
        raise PluginError(
            "no C compiler was found, so the program cannot be checked against the model",
            hint="install gcc or clang, set CC=… to a compiler, or export without the check "
            "(--no-check) and run the self-test on the target",
        )
    return found


def compile_program(
    folder: Path, files: Sequence[str], out: str, flags: Sequence[str] = (PORTABLE,)
) -> Path:
    """Compile and link files of a folder, which is also searched for headers.

    Raises:
        FitError: The compiler reports an error in the program, which is a fault of the export.
        PluginError: There is no compiler, or the compiler cannot compile any program.
    """
    done = _compiled(folder, files, out, (*STRICT, *flags, "-I."))
    if done.returncode or not (folder / out).is_file():
        _require_works(flags)
        raise FitError(
            f"the C program does not compile: {done.stderr.strip()[:500]}",
            hint="this is a fault of hil's export: please report it with the model folder",
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
            hint="install gcc or clang, set CC=… to a compiler, or skip the check with --no-check",
        ) from error


def _require_works(flags: Sequence[str]) -> None:
    """Raise if the compiler cannot compile an empty program."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.c").write_text(NOTHING, "utf-8")
        done = _compiled(folder, ("a.c",), "a.out", flags)
        if done.returncode == 0 and (folder / "a.out").is_file():
            return
    raise PluginError(
        f"{shlex.join(require_compiler())} does not compile: {done.stderr.strip()[:300]}",
        hint="set CC=… to a C compiler for this machine",
    )


def run_self_test(folder: Path, program: Path) -> str:
    """Run a self-test; return its agreement, and on a separate line the size of the state.

    Raises:
        FitError: The self-test fails.
    """
    done = _run([str(program)], folder)
    said = done.stdout.strip()
    if done.returncode:
        raise FitError(
            f"the C program does not agree with the model: {said or f'exit {done.returncode}'}",
            hint="this is a fault of hil's export: please report it with the model folder",
        )
    return said


def asked(arguments: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the compiler with the passed arguments in a folder; the caller checks the result.

    Raises:
        FitError: The compiler cannot be run.
        PluginError: There is no compiler.
    """
    return _run([*require_compiler(), *arguments], folder)


FRAMES = "-fstack-usage"


def stack_bytes(folder: Path, prefix: str, flags: Sequence[str] = (PORTABLE,)) -> int | None:
    """Return the maximum stack size [bytes] of a call of the program, without that of `math.h`.

    No function of an exported program is recursive or called through a pointer. The stack frames of
    all internal functions plus the largest frame of the public functions are therefore an upper
    limit of the stack size.

    Args:
        folder: Folder with the program.
        prefix: Prefix of the program files.
        flags: Flags of the compiler.

    Returns:
        Stack size [bytes]; None if the compiler does not report a stack size, or a frame has no
        fixed maximum.

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
    """Return a note on stack and state sizes and on the compiler that determined them.

    Args:
        folder: Folder with the program.
        prefix: Prefix of the program files.
        state: Text about the size of the state, which the self-test prints.
    """
    stack = stack_bytes(folder, prefix)
    frames = "" if stack is None else f"at most {stack} bytes of stack without that of math.h, "
    told = asked(("--version",), folder).stdout.partition("\n")[0]
    machine = asked(("-dumpmachine",), folder).stdout.strip()
    return f"{frames}{state} ({', '.join(filter(None, (told, PORTABLE, machine)))})"
