"""How much stack a program takes at most: what a task on a controller has to be given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.export.c_build import PORTABLE, asked

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


def _called(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{name}" for name in ("step", "reset", "set_load"))
