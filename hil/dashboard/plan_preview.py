"""Plans that are shown, and confirmed, before anything is started; nothing moves here.

A plan may take hours and more memory than there is, whereas the dashboard, Stop and other plans
must not wait. So `plan_in_process` runs this module as a process of its own (`main`): it is asked
by one line of JSON on its input, answers with one document, and ends when the client leaves, when
its input is closed (the dashboard was killed), or at a limit of time or memory.

Two digests tie a start to what its operator has seen. `experiments_digest` is of all that decides
what the arm does: a form that was checked sends it back, and nothing is started if it differs.
`ShownMotions` remembers the motion of each real robot that a page has shown, by its digest; it is
confirmed by typing the name of the robot (`refusal_of`).
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import starmap
from pathlib import Path
from typing import Any

from hil.arms import arm_names
from hil.core import BLAS_VARIABLES, HilError, NotConfirmed, PlanError, RobotError, SpecError
from hil.planning import (
    Commissioning,
    Experiment,
    Plan,
    PlanPreview,
    commissioning_of,
    moves_for_real,
    opened,
)
from hil.report import duration, measure, named, picture_of, size
from hil.spec import spec_hash
from hil.workflow import (
    WITHOUT_THE_ROBOT,
    MotionFacts,
    Unfinished,
    check_start,
    digest_of,
    facts_of_all,
    motion_facts,
    open_unfinished,
    own_environment,
    preview_experiment,
    prompts_of,
    remaining_motion,
)

PLANS = threading.BoundedSemaphore(2)
"""Plans that are made at the same time: each takes a core for seconds."""


async def plans_to_show(
    request: Callable[[], Awaitable[Mapping[str, Any]]], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """Plan what a form asks for.

    Args:
        request: Returns what is to be planned, see `plan_in_process`.
        gone: Whether the client has left.

    Returns:
        `plans`, and the digests that the form sends back: `checked` of what was planned, `facts`
        of the motions that have to be confirmed, empty where none has to be. Instead of them
        `error` and its HTTP `status` where there is no plan.

    Raises:
        ClientGone: The client has left.
    """
    if not PLANS.acquire(blocking=False):
        busy = HilError("two plans are being made at the moment", hint="try again in a moment")
        return {"error": busy, "status": 503}
    try:
        answer = await plan_in_process(await request(), gone)
    except HilError as error:
        return {"error": error, "status": 422}
    finally:
        PLANS.release()
    motions = [plan["motion"] for plan in answer["plans"] if plan["motion"]]
    facts = MOTIONS.keep(motions) if motions else ""
    return {"plans": answer["plans"], "checked": answer["digest"], "facts": facts}


NOT_SHOWN = NotConfirmed(
    "not started: a real robot would move, and its motion was not confirmed",
    hint="below is what it would do; type the name of the robot to confirm it",
)

CHANGED = SpecError(
    "not started, for it is not what was checked: the form or a file was changed since",
    hint="below is what would be done now; look at it and start it again",
)


def refusal_of(fields: Mapping[str, str], digest: str, *, real: bool) -> HilError | None:
    """Return why what a form asks for is not started; None if it is.

    Args:
        fields: Fields of the form: `checked`, `facts` and `confirm`.
        digest: Of what would be started now, see `experiments_digest`.
        real: Whether its motion has to be confirmed.
    """
    if fields.get("checked", "") not in ("", digest):
        return CHANGED
    if not real:
        return None
    facts = MOTIONS.confirmed(fields.get("facts", ""))
    if facts and not (facts.get("robot") and facts.get("address")):
        robots = {f"{one['robot']} at {one['address']}": None for one in facts["motions"]}
        return NotConfirmed(
            f"not started: it moves {' and '.join(robots)}, and this form confirms one robot",
            hint=f"start it on the command line: hil run {fields.get('spec', '')}".rstrip(),
        )
    if not (facts and fields.get("checked")):
        return NOT_SHOWN
    if fields.get("confirm", "").strip() != facts["robot"]:
        return NotConfirmed(
            f"not started: {facts['robot']} was not confirmed",
            hint=f"look at what it will do, then type {facts['robot']} to confirm it",
        )
    return None


MOST_MOTIONS = 200
"""Plans of real robots whose facts are remembered until they are confirmed."""


class ShownMotions:
    """Motions of real robots that pages have shown, by the digest that their form sends back."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, list[dict[str, Any]]] = OrderedDict()
        self._looking = threading.Lock()

    def keep(self, motions: list[dict[str, Any]]) -> str:
        """Return the digest of motions, `MotionFacts.to_dict` each, and remember them."""
        digest = digest_of({"motions": motions})
        with self._looking:
            self._kept[digest] = motions
            while len(self._kept) > MOST_MOTIONS:
                self._kept.popitem(last=False)
        return digest

    def confirmed(self, digest: str) -> dict[str, Any]:
        """Return what a digest confirms, see `facts_of_all`; empty if no page has shown it."""
        with self._looking:
            return facts_of_all(self._kept.get(digest, []))


MOTIONS = ShownMotions()


def experiments_digest(experiments: Iterable[Experiment], speed: str = "", first: str = "") -> str:
    """Return a SHA-256 of everything that decides what the arm does, except where it stands.

    Args:
        experiments: Of each: its spec as resolved (a file of poses by its content), its station,
            and the description of a custom robot by its content.
        speed: Share of the speed, as typed.
        first: Part of the program, as typed.

    Raises:
        SpecError: A file cannot be read.
    """
    parts = [
        [spec_hash(one.spec), one.station.model_dump(mode="json"), _arm_digest(one.robot.model)]
        for one in experiments
    ]
    text = json.dumps([parts, speed, first], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _arm_digest(model: str) -> str:
    """Return the SHA-256 of a custom robot's file as it is now, empty for a built-in arm.

    `model_sha256` is of the content that this process has read, which may be older.
    """
    if model in arm_names():
        return ""
    try:
        return hashlib.sha256(Path(model).read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None


LIMIT_S = 60.0
MOST_BYTES = 4 * 1024**3
LOOKS_EVERY_S = 0.5
MODULE = "hil.dashboard.plan_preview"


class ClientGone(Exception):
    """The client has left: its plan is not needed any more."""


async def plan_in_process(
    request: Mapping[str, Any], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """Plan an experiment, a series, or the rest of a run, in a process of its own.

    Args:
        request: `spec`, `station`, `overrides`, `speed` and `first`; or `run`, the directory of a
            run that is to be resumed.
        gone: Whether the client has left.

    Returns:
        `plans`, see `shown_plan`, and `digest`, see `experiments_digest`.

    Raises:
        HilError: Planning failed, exceeded its time limit or exceeded its memory limit.
        ClientGone: The client has left.
    """
    process = subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-P", "-m", MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        env=own_environment() | dict.fromkeys(BLAS_VARIABLES, "1"),
    )
    line = json.dumps({**request, "bytes": MOST_BYTES}).encode() + b"\n"
    output = asyncio.get_running_loop().run_in_executor(None, _communicate, process, line)
    try:
        await _until_done(output, gone)
    finally:  # also if this request is cancelled, with the dashboard
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    text = output.result()
    try:
        answer = json.loads(text)
    except ValueError:  # it broke
        answer = None
    if not (isinstance(answer, dict) and answer):
        answer = {"error": f"planning ended without an answer (code {code})", "broken": True}
    if "broken" in answer:
        gb = MOST_BYTES / 1024**3
        hint = f"a plan may take {gb:.2g} GB here; plan it with `hil plan`"
        raise PlanError(f"no plan: {answer['error']}", hint=hint)
    if "error" in answer:
        raise HilError(answer["error"], hint=answer["hint"])
    return answer


def _communicate(process: subprocess.Popen[bytes], line: bytes) -> bytes:
    """Return all its output. Its input stays open meanwhile, as a sign that a client waits."""
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdout:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and may have said why
            process.stdin.write(line)
            process.stdin.flush()
        output = process.stdout.read()
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    return output


async def _until_done(output: asyncio.Future[bytes], gone: Callable[[], Awaitable[bool]]) -> None:
    until = time.monotonic() + LIMIT_S
    while not (await asyncio.wait({output}, timeout=LOOKS_EVERY_S))[0]:
        if await gone():
            raise ClientGone
        if time.monotonic() > until:
            raise PlanError(
                f"this plan takes longer than {LIMIT_S:g} s",
                hint="plan it with `hil plan`; or start it: the run takes the time it needs",
            )


TOO_LARGE = "its arrays do not fit into the memory that a plan may take here"


def main() -> None:
    """Plan what the first line of the input asks for, and print the answer."""
    answers = os.dup(1)
    os.dup2(2, 1)  # whatever else prints is no part of the answer
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_the_client, daemon=True).start()
    resource.setrlimit(resource.RLIMIT_DATA, (request["bytes"],) * 2)
    with open(answers, "w", encoding="utf-8") as output:
        json.dump(_answer(request), output)


def _end_with_the_client() -> None:
    sys.stdin.read()
    os.killpg(0, signal.SIGKILL)


def _answer(request: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return _plan(request)
    except MemoryError:
        return {"error": TOO_LARGE, "broken": True}
    except HilError as error:
        return {"error": error.message, "hint": error.hint or ""}


def _plan(request: Mapping[str, Any]) -> dict[str, Any]:
    if "run" in request:
        unfinished = open_unfinished(Path(request["run"]))
        plans = [shown_rest(unfinished)]
        return {"plans": plans, "digest": experiments_digest([unfinished.experiment])}
    station = Path(request["station"]) if request["station"] else None
    part = commissioning_of(request["speed"], request["first"])
    experiments = check_start(Path(request["spec"]), station, request["overrides"], part)
    digest = experiments_digest(experiments, request["speed"], request["first"])
    plans = [
        shown_plan(each, part, draw=number < PICTURES) for number, each in enumerate(experiments)
    ]
    return {"plans": plans, "digest": digest}


PICTURES = 3
"""Plans of a long series that are drawn: a picture has some hundred kilobytes."""

UNASKED = (
    "Planned without the robot, which was not connected to: this plan begins in the roomiest pose "
    "of its range, and limits are the maker's; once started, the run plans anew from where the arm "
    "stands, before it moves."
)


def shown_plan(
    experiment: Experiment, part: Commissioning | None, *, draw: bool = True
) -> dict[str, Any]:
    """Return what an experiment would do.

    Args:
        experiment: What would be run, and on which robot.
        part: Part of its program; None for all.
        draw: Whether to draw it, which takes most of a second.

    Raises:
        PlanError: The spec has no safe plan, or nothing of it would be measured.
        RobotError: A robot on a virtual clock cannot be asked where it stands.

    Returns:
        Values of the template. `motion` is what has to be confirmed before a real robot moves
        (`MotionFacts.to_dict`); None for mocks, and if the robot could not be asked where it
        stands, as the swept space depends on that.
    """
    experiment = replace(experiment, commissioning=part)
    plan, facts, motion, unreached = _previewed(experiment)
    part = part and part.within(plan)
    return {
        "title": experiment.title,
        "description": experiment.spec.description,
        "rows": list(_rows(facts, part)),
        "interlocks": facts.interlocks,
        "warnings": [text for text in facts.warnings if text != WITHOUT_THE_ROBOT] + unreached,
        "motion": motion and motion.to_dict(),
        "motion_rows": motion.rows() if motion else [],
        "notes": list(_notes(facts, part)),
        "prompts": prompts_of(plan),
        "picture": _picture(plan) if draw else "",
    }


def shown_rest(unfinished: Unfinished) -> dict[str, Any]:
    """Return what going on with a run would do; `motion` and `motion_rows` as in `shown_plan`.

    Raises:
        HilError: It cannot be planned from where the arm stands, see `remaining_motion`.
    """
    motion = remaining_motion(unfinished)
    return {
        "title": f"The rest of {unfinished.experiment.spec.name}",
        "motion": motion and motion.to_dict(),
        "motion_rows": motion.rows() if motion else [],
    }


def _previewed(
    experiment: Experiment,
) -> tuple[Plan, PlanPreview, MotionFacts | None, list[str]]:
    if not moves_for_real(experiment):
        return *preview_experiment(experiment), None, []
    try:
        plan, facts = preview_experiment(experiment, connect=True)
    except RobotError as error:
        message = (
            f"{error.message}. The run can start after it has been planned from the robot's "
            "current position."
        )
        return *preview_experiment(experiment), None, [message]
    with opened(experiment.spec.robot, experiment.robot) as robot:
        return plan, facts, motion_facts(experiment, robot, plan), []


def _rows(facts: PlanPreview, part: Commissioning | None) -> Iterator[tuple[str, str]]:
    if part is not None:
        yield "part of the program", str(part)
    yield "time", duration(facts.duration_s)
    yield from facts.swept.rows()[1:]
    yield "steps", ", ".join(f"{count} {kind}" for kind, count in facts.steps.items())
    yield "poses", str(facts.waypoints)
    yield "recording", size(facts.recording_bytes)
    if part is None:
        yield "condition number", measure(facts.condition_number, "1")
    for name, text in starmap(named, facts.margins.items()):
        yield f"margin: {name}", text


def _notes(facts: PlanPreview, part: Commissioning | None) -> Iterator[str]:
    """Return what an operator of the page, who sees no command line, has to know."""
    if part is not None:
        yield "A trial of the arm: nothing is fitted or judged, and it cannot be gone on with."
    if WITHOUT_THE_ROBOT in facts.warnings:
        yield UNASKED


def _picture(plan: Plan) -> str:
    """Return the picture of a plan as a data URI: no script in it runs, no style leaves it."""
    data = base64.b64encode(picture_of(plan).encode()).decode()
    return f"data:image/svg+xml;base64,{data}"


if __name__ == "__main__":
    main()
