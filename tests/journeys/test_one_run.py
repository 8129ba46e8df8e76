"""One small run, traced: what is read, built, opened or predicted is so once, not once a caller."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from typer.testing import CliRunner

import hil
from hil.arms import description
from hil.cli.app import app
from hil.core.yaml import parse
from hil.dynamics import base, build, collision
from hil.engine import interlocks as interlock_builder
from hil.estimators import rigid_linear
from hil.planning import robots, workspace

SPEC = """\
hil: 1
name: tiny
robot: ur5
excitation: {kind: fourier, trajectories: 3, harmonics: 3, fundamental_hz: 0.5, seed: 7}
fit: [{estimator: rigid-wls}]
validate: {hold_out: {trajectories: 1}}
"""

HIL = str(Path(hil.__file__).parent)


class Trace:
    """Calls of traced functions, and the files of hil that were entered.

    Args:
        named: Code object → what its call is, from its arguments.
    """

    def __init__(self, named: dict[CodeType, Callable[[dict[str, Any]], str]]) -> None:
        self._named = named
        self._calls: list[str] = []
        self.files: set[str] = set()

    def __call__(self, frame: FrameType, event: str, arg: object) -> None:
        """See `sys.setprofile`."""
        if event != "call":
            return
        code = frame.f_code
        if code.co_filename.startswith(HIL):
            self.files.add(code.co_filename)
        if code in self._named:
            self._calls.append(self._named[code](frame.f_locals))

    @property
    def counts(self) -> Counter[str]:
        """How often each was called."""
        return Counter(self._calls)


def named(text: str) -> Callable[[dict[str, Any]], str]:
    return lambda _: text


def parsed(arguments: dict[str, Any]) -> str:
    file = Path(arguments["name"])
    return "copy of the spec in the run parsed" if file.name == "spec.yaml" else "spec parsed"


def predicted(arguments: dict[str, Any]) -> str:
    numbers = ", ".join(str(each.trajectory) for each in arguments["dataset"].conditions)
    return f"prediction of trajectories {numbers}"


def traced() -> Trace:
    return Trace(
        {
            parse.__code__: parsed,
            description.arm_from_dict.__code__: named("arm parsed"),
            build.model_of_dh.__code__: named("robot model built"),
            collision.CollisionModel.__init__.__code__: named("collision model built"),
            base.BaseParameters.from_regressor.__func__.__code__: named("base parameters"),  # type: ignore[attr-defined]
            robots.open_robot.__code__: named("robot opened"),
            interlock_builder.interlocks_from_spec.__code__: named("interlocks built"),
            rigid_linear.RigidLinear.predict.__code__: predicted,
        }
    )


@contextmanager
def profiled(trace: Trace) -> Iterator[None]:
    """Trace this thread and those that begin meanwhile, with nothing cached from other tests."""
    for cache in (description._parsed, build._built, workspace._built, base._sampled):
        cache.cache_clear()
    before = sys.getprofile()
    sys.setprofile(trace)
    threading.setprofile(trace)
    try:
        yield
    finally:
        threading.setprofile(None)  # type: ignore[arg-type]
        sys.setprofile(before)


def by_command(spec: Path, runs: Path) -> None:
    done = CliRunner().invoke(app, ["run", str(spec), "--runs", str(runs)])
    assert done.exit_code == 0, done.output


def by_call(spec: Path, runs: Path) -> None:
    report = hil.run(hil.load(spec), runs=runs)
    assert report.error is None
    assert report.outcome == "completed"


@pytest.mark.thorough
@pytest.mark.parametrize(("run", "read_again"), [(by_command, 2), (by_call, 1)])
def test_one_run_makes_each_thing_once(
    run: Callable[[Path, Path], None], read_again: int, tmp_path: Path
) -> None:
    spec = tmp_path / "tiny.yaml"
    spec.write_text(SPEC, "utf-8")
    trace = traced()
    with profiled(trace):
        run(spec, tmp_path / "runs")
    entered = f"{run.__name__}: {len(trace.files)} files of hil entered"
    print(f"{entered}; {dict(trace.counts)}")  # noqa: T201 - information for a reader of the log
    assert trace.counts == {
        "spec parsed": 1,
        "arm parsed": 1,
        "robot model built": 1,
        "collision model built": 1,
        "base parameters": 1,
        "robot opened": 1,
        # The report and the summary in the terminal each read the run directory.
        "copy of the spec in the run parsed": read_again,
        "interlocks built": 1,
        "prediction of trajectories 0, 1": 1,
        "prediction of trajectories 2": 1,
    }
