"""Plans for the forms that start something, each made by a process of its own that can be ended.

What a browser asks for may take hours and more memory than there is; the dashboard, Stop and
other people's plans must not wait for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from hil.core import BLAS_VARIABLES, HilError, PlanError
from hil.workflow import own_environment

LIMIT_S = 60.0
MOST_BYTES = 4 * 1024**3
LOOKS_EVERY_S = 0.5
MODULE = "hil.dashboard.plan_process"


class Gone(Exception):
    """Nobody waits for the plan any more."""


async def plan_apart(
    asked: Mapping[str, Any], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """A plan, or those of a series, as `hil.dashboard.plan_process` answers.

    Args:
        asked: `spec`, `station`, `overrides`, `speed` and `first`; or `run`, the directory of a run
            that is to go on.
        gone: Whether whoever asked has left.

    Returns:
        `plans`, as `hil.dashboard.plan_shown` has them, and `digest` of what was planned.

    Raises:
        HilError: What the planning said; or it took too long, or too much memory.
        Gone: Whoever asked has left.
    """
    process = subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-P", "-m", MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        env=_environment(),
    )
    line = json.dumps({**asked, "bytes": MOST_BYTES}).encode() + b"\n"
    said = asyncio.get_running_loop().run_in_executor(None, _said, process, line)
    try:
        await _until_done(said, gone)
    finally:  # also where this request was ended, with the dashboard
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    answer = _document(said.result()) or {
        "error": f"planning ended without an answer (code {code})",
        "broken": True,
    }
    if "broken" in answer:
        gb = MOST_BYTES / 1024**3
        hint = f"a plan may take {gb:.2g} GB here; plan it with `hil plan`"
        raise PlanError(f"no plan: {answer['error']}", hint=hint)
    if "error" in answer:
        raise HilError(answer["error"], hint=answer["hint"])
    return answer


def _said(process: subprocess.Popen[bytes], line: bytes) -> bytes:
    """Everything it prints; its input stays open meanwhile: it tells that somebody waits."""
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdout:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and may have said why
            process.stdin.write(line)
            process.stdin.flush()
        told = process.stdout.read()
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    return told


async def _until_done(said: asyncio.Future[bytes], gone: Callable[[], Awaitable[bool]]) -> None:
    until = time.monotonic() + LIMIT_S
    while not (await asyncio.wait({said}, timeout=LOOKS_EVERY_S))[0]:
        if await gone():
            raise Gone
        if time.monotonic() > until:
            raise PlanError(
                f"this plan takes longer than {LIMIT_S:g} s",
                hint="plan it with `hil plan`; or start it: the run takes the time it needs",
            )


def _document(said: bytes) -> dict[str, Any]:
    """What it answered; empty where it broke."""
    try:
        answer = json.loads(said)
    except ValueError:
        return {}
    return answer if isinstance(answer, dict) else {}


def _environment() -> dict[str, str]:
    return own_environment() | dict.fromkeys(BLAS_VARIABLES, "1")
