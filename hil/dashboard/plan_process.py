"""One plan, made in a process that the dashboard may end: `python -m hil.dashboard.plan_process`.

It is asked by one line of JSON and answers with one document. It ends with whoever asked: its input
is closed then, also where they were killed.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.core import HilError
from hil.dashboard.checked import digest_of
from hil.planning import commissioning_of

TOO_LARGE = "its arrays do not fit into the memory that a plan may take here"


def main() -> None:
    """Answer what the first line of the input asks."""
    answers = os.dup(1)
    os.dup2(2, 1)  # whatever else prints is no part of the answer
    asked = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_the_asker, daemon=True).start()
    resource.setrlimit(resource.RLIMIT_DATA, (asked["bytes"],) * 2)
    with open(answers, "w", encoding="utf-8") as answer:
        json.dump(_answer(asked), answer)


def _end_with_the_asker() -> None:
    sys.stdin.read()
    os.killpg(0, signal.SIGKILL)


def _answer(asked: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return _planned(asked)
    except MemoryError:
        return {"error": TOO_LARGE, "broken": True}
    except HilError as error:
        return {"error": error.message, "hint": error.hint or ""}


def _planned(asked: Mapping[str, Any]) -> dict[str, Any]:
    from hil.dashboard.plan_shown import PICTURES, shown_plan, shown_rest
    from hil.workflow import check_start, open_unfinished

    if "run" in asked:
        unfinished = open_unfinished(Path(asked["run"]))
        return {"plans": [shown_rest(unfinished)], "digest": digest_of([unfinished.experiment])}
    station = Path(asked["station"]) if asked["station"] else None
    part = commissioning_of(asked["speed"], asked["first"])
    experiments = check_start(Path(asked["spec"]), station, asked["overrides"], part)
    digest = digest_of(experiments, asked["speed"], asked["first"])
    plans = [
        shown_plan(each, part, draw=number < PICTURES) for number, each in enumerate(experiments)
    ]
    return {"plans": plans, "digest": digest}


if __name__ == "__main__":
    main()
