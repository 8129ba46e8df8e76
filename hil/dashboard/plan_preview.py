"""Plans that are shown and confirmed before a start; this module moves no robot.

The computation of a plan possibly takes hours and exhausts the memory. The dashboard, Stop and
other plans must not wait meanwhile. Therefore `plan_in_process` runs this module in a separate
process (`main`). The separate process reads one line of JSON from its input and answers with one
document. The separate process ends if the client disconnects, if its input is closed (the dashboard
was killed), or at a limit of time or memory.

Two digests ensure that a started run matches the plan that the operator has seen. The digest
`experiments_digest` covers everything that determines the motion of the arm: a checked form sends
the digest back, and the start is rejected if the digest has changed. `ShownMotions` stores the
displayed motion of each real robot under the digest of the motion. The operator confirms the motion
by typing the name of the robot (`refusal_of`).
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
"""Maximum number of simultaneous plans, each of which uses a processor core for seconds."""


async def plans_to_show(
    request: Callable[[], Awaitable[Mapping[str, Any]]], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """Plan the request of a form.

    Args:
        request: Function that returns the request, see `plan_in_process`.
        gone: Function that returns whether the client has left.

    Returns:
        `plans`, and the digests that the form sends back: `checked` for the plan, and `facts` for
        the motions to be confirmed, empty if there are none. If there is no plan, `error` and its
        HTTP `status` instead.

    Raises:
        ClientGone: The client has left.
    """
    if not PLANS.acquire(blocking=False):
        busy = HilError("two plans are already being computed", hint="try again in a moment")
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
    hint="check the plan below, then type the name of the robot to confirm its motion",
)

CHANGED = SpecError(
    "not started: the form or a file was changed after the check",
    hint="check the new plan below, then start again",
)


def refusal_of(fields: Mapping[str, str], digest: str, *, real: bool) -> HilError | None:
    """Return the reason why the request of a form is rejected; None if it is accepted.

    Args:
        fields: Fields of the form, of which `checked`, `facts` and `confirm` are read.
        digest: Digest of the experiments that would be started now, computed by
            `experiments_digest`.
        real: Whether the motion of a real robot must be confirmed.
    """
    if fields.get("checked", "") not in ("", digest):
        return CHANGED
    if not real:
        return None
    facts = MOTIONS.confirmed(fields.get("facts", ""))
    if facts and not (facts.get("robot") and facts.get("address")):
        robots = {f"{one['robot']} at {one['address']}": None for one in facts["motions"]}
        return NotConfirmed(
            f"not started: it moves {' and '.join(robots)}, but this form confirms one robot",
            hint=f"start it on the command line: hil run {fields.get('spec', '')}".rstrip(),
        )
    if not (facts and fields.get("checked")):
        return NOT_SHOWN
    if fields.get("confirm", "").strip() != facts["robot"]:
        return NotConfirmed(
            f"not started: {facts['robot']} was not confirmed",
            hint=f"check the plan below, then type {facts['robot']} to confirm its motion",
        )
    return None


MOST_MOTIONS = 200
"""Maximum number of stored motions of real robots that await confirmation."""


class ShownMotions:
    """Displayed motions of real robots, by the digest that the form of the motion sends back."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, list[dict[str, Any]]] = OrderedDict()
        self._looking = threading.Lock()

    def keep(self, motions: list[dict[str, Any]]) -> str:
        """Store motions (results of `MotionFacts.to_dict`) and return their digest."""
        digest = digest_of({"motions": motions})
        with self._looking:
            self._kept[digest] = motions
            while len(self._kept) > MOST_MOTIONS:
                self._kept.popitem(last=False)
        return digest

    def confirmed(self, digest: str) -> dict[str, Any]:
        """Return the motion facts that a digest confirms (`facts_of_all`), or empty facts."""
        with self._looking:
            return facts_of_all(self._kept.get(digest, []))


MOTIONS = ShownMotions()


def experiments_digest(experiments: Iterable[Experiment], speed: str = "", first: str = "") -> str:
    """Return a SHA-256 digest of everything that determines the motion, except the initial pose.

    Args:
        experiments: Experiments that the digest covers. The digest covers the resolved spec (with
            the content of a file of poses), the station, and the content of the description file of
            a custom robot.
        speed: Speed as a share of full speed, as the operator typed it.
        first: Part of the program to be executed, as the operator typed it.

    Raises:
        SpecError: One of the covered files cannot be read.
    """
    parts = [
        [spec_hash(one.spec), one.station.model_dump(mode="json"), _arm_digest(one.robot.model)]
        for one in experiments
    ]
    text = json.dumps([parts, speed, first], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _arm_digest(model: str) -> str:
    """Return the SHA-256 digest of the current file of a custom robot; empty for a built-in arm.

    The attribute `model_sha256` is not used here, because it is the digest of the content that this
    process has read, which is possibly outdated.
    """
    if model in arm_names():
        return ""
    try:
        return hashlib.sha256(Path(model).read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="check that it exists"
        ) from None


LIMIT_S = 60.0
MOST_BYTES = 4 * 1024**3
LOOKS_EVERY_S = 0.5
MODULE = "hil.dashboard.plan_preview"


class ClientGone(Exception):
    """Exception for a client that has disconnected, so that its plan is no longer needed."""


async def plan_in_process(
    request: Mapping[str, Any], gone: Callable[[], Awaitable[bool]]
) -> dict[str, Any]:
    """Plan an experiment, a series, or the remainder of a run in a separate process.

    Args:
        request: `spec`, `station`, `overrides`, `speed` and `first`, or `run` with the run
            directory of a run to resume.
        gone: Function that returns whether the client has left.

    Returns:
        `plans`, see `shown_plan`, and `digest`, see `experiments_digest`.

    Raises:
        HilError: Planning failed, or exceeded its limit of time or memory.
        ClientGone: The client has left.
    """
    process = subprocess.Popen(  # noqa: S603 - runs this module
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
    finally:  # also if the dashboard cancels this request
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    text = output.result()
    try:
        answer = json.loads(text)
    except ValueError:  # not valid JSON
        answer = None
    if not (isinstance(answer, dict) and answer):
        answer = {"error": f"planning ended without an answer (code {code})", "broken": True}
    if "broken" in answer:
        gb = MOST_BYTES / 1024**3
        hint = f"a plan may use {gb:.2g} GB of memory here; plan it with `hil plan`"
        raise PlanError(f"no plan: {answer['error']}", hint=hint)
    if "error" in answer:
        raise HilError(answer["error"], hint=answer["hint"])
    return answer


def _communicate(process: subprocess.Popen[bytes], line: bytes) -> bytes:
    """Return the complete output of the planning process.

    The input of the planning process stays open meanwhile, as a sign that a client waits.
    """
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdout:
        with contextlib.suppress(BrokenPipeError):  # the process has ended, possibly with an answer
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
                hint="plan it with `hil plan`, or start it: a run has no time limit for planning",
            )


TOO_LARGE = "its arrays do not fit into the memory that a plan may use here"


def main() -> None:
    """Plan the request in the first input line, and print the response."""
    answers = os.dup(1)
    os.dup2(2, 1)  # other output must not be part of the answer
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
"""Maximum number of plans with a picture in a series, because a picture has some hundred
kilobytes.
"""

UNASKED = (
    "Planned without a connection to the robot: this plan begins at the least obstructed pose of "
    "its range and uses the manufacturer's limits. After its start and before any motion, the run "
    "plans again from the current pose of the arm."
)


def shown_plan(
    experiment: Experiment, part: Commissioning | None, *, draw: bool = True
) -> dict[str, Any]:
    """Return the plan of an experiment in the form that the page shows.

    Args:
        experiment: Experiment with the name of its robot.
        part: Part of the program to be planned; None for the whole program.
        draw: Whether to include a picture, whose computation takes most of a second.

    Raises:
        PlanError: The spec has no safe plan, or the plan contains no measurement.
        RobotError: The pose of a robot that uses a virtual clock cannot be read.

    Returns:
        Values that the template of the page inserts. The value `motion` is the motion to be
        confirmed before a real robot moves (`MotionFacts.to_dict`). The value `motion` is None for
        mock robots. The value `motion` is also None if the pose of the robot could not be read,
        because the swept space depends on the pose.
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
    """Return the remaining plan of a run; `motion` and `motion_rows` are as in `shown_plan`.

    Raises:
        HilError: The motion from the current pose cannot be planned (see `remaining_motion`).
    """
    motion = remaining_motion(unfinished)
    return {
        "title": f"Rest of {unfinished.experiment.spec.name}",
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
    """Yield notes for an operator at the page, who does not see the output of the command line."""
    if part is not None:
        yield "A commissioning run: nothing is fitted or evaluated, and it cannot be resumed."
    if WITHOUT_THE_ROBOT in facts.warnings:
        yield UNASKED


def _picture(plan: Plan) -> str:
    """Return the picture of a plan as a data URI, so that its scripts and styles are isolated."""
    data = base64.b64encode(picture_of(plan).encode()).decode()
    return f"data:image/svg+xml;base64,{data}"


if __name__ == "__main__":
    main()
