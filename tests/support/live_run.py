"""A real engine on a robot without physics, live and listening.

`python live_run.py RUNS [PROMPT [twice]]` prints the run directory when it has begun. The plan goes
on for minutes; it may ask the same twice.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
BLOCKS_EVERY_S = 0.002


@contextlib.contextmanager
def live_run(
    runs: Path, prompt: str = "", times: str = ""
) -> Iterator[tuple[Path, subprocess.Popen[str]]]:
    """The run directory and process of such a run; killed on the way out."""
    with subprocess.Popen(
        [sys.executable, __file__, str(runs), prompt, times],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], 30)[0], "the run does not begin"
            yield Path(process.stdout.readline().strip()), process
        finally:
            process.kill()


def _main(runs: Path, prompt: str, times: str) -> None:
    from hil.arms.payload import Payload
    from hil.core.lock_file import hold_run
    from hil.engine import Engine, Observers
    from hil.excitation.motion import Hold
    from hil.planning.plan import DwellRule, LoadStep, Plan, Step
    from hil.recording.run_directory import RunDirectory
    from hil.workflow.live_state import LiveState
    from hil.workflow.operator import ConsoleOperator
    from hil.workflow.remote_control import Control
    from tests.support.engine_parts import ListSink, line
    from tests.support.kinematic_robot import KinematicRobot

    first = 2 if times == "twice" else 1
    steps = [Step(i, "payload", load=i) for i in range(first)]
    for i in range(first, 2000, 2):
        at = (0.1 if (i - first) % 4 == 0 else -0.1,) * 6
        steps.append(Step(i, "move", line(-at[0], at[0]) if i > first else line(0.0, at[0]),
                          checkpoint=True))  # fmt: skip
        steps.append(Step(i + 1, "dwell", Hold(at), pose=i // 2))
    names = tuple(f"j{i + 1}" for i in range(6))
    loads = (LoadStep(Payload(1.0), prompt),) * first
    plan = Plan("live", "ur5", names, 125.0, tuple(steps), loads, DwellRule(samples=10))

    class LoggingSink(ListSink):
        def event(self, kind: str, **details: Any) -> None:
            log.append(kind, **details)

        def put(self, rows: Any) -> None:
            time.sleep(BLOCKS_EVERY_S)

    robot = KinematicRobot()
    robot.connect()
    run = RunDirectory.create(runs, "ur5", "live")
    with hold_run(run.path), run.event_log() as log:
        run.write_start({"uid": f"u-{os.getpid()}"})
        live = LiveState(run.path)
        operator, observers, sink = ConsoleOperator(), Observers((live,)), LoggingSink()
        engine = Engine(plan, robot, sink, observers=observers, prompt=operator)
        with Control(run.path, engine, sink.event, operator):
            sys.stdout.write(f"{run.path}\n")
            sys.stdout.flush()
            result = engine.run()
        observers.close()
        run.write_stop(result.outcome.value, result.reason)
        live.close()


if __name__ == "__main__":
    _main(Path(sys.argv[1]), *sys.argv[2:4])
