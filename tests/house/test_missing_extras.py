"""Whatever is missing is told in one sentence, with the command that brings it; tried for real."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hil.core import plugins
from tests.support.paths import EXPERIMENTS, ROOT

CHILD = ROOT / "tests" / "house" / "missing_modules.py"
DWELL = EXPERIMENTS / "ci_dwell_12.yaml"
BAGS = EXPERIMENTS / "maps" / "ros2_joint_states.yaml"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("modules", "words", "told", "extra"),
    [
        ("uvicorn", ("serve", "--port", "0"), "the dashboard needs uvicorn, which is", "web"),
        ("starlette,uvicorn", ("serve",), "needs starlette and uvicorn, which are", "web"),
        ("numba", ("run", DWELL), "the mock robot needs numba, which is", "mock"),
        ("numba", ("mock", "ur", "--port", "0"), "the mock robot needs numba, which is", "mock"),
        ("foxglove", ("run", DWELL, "--live"), "the live view needs foxglove, which is", "live"),
        (
            "rosbags",
            ("import", EXPERIMENTS, "--map", BAGS, "-o", "x.mcap"),
            "reading ROS 2 bags needs rosbags, which is",
            "bags",
        ),
    ],
)
def test_a_verb_without_its_extra_says_so(
    modules: str, words: tuple[str | Path, ...], told: str, extra: str, tmp_path: Path
) -> None:
    command = [sys.executable, CHILD, modules, *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=100)
    assert f"{told} not installed\n" in done.stderr
    assert f'pip install "hil[{extra}]"' in done.stderr
    assert done.returncode not in (0, 1)


def test_one_module_is_and_several_are_not_installed() -> None:
    one = plugins.not_installed("this", ["torch"], "learn", purpose="to train")
    assert one.message == "this needs torch, which is not installed, to train"
    some = plugins.not_installed("this", ["a", "b", "c"], "x", "y", otherwise="do without")
    assert some.message == "this needs a, b and c, which are not installed"
    assert some.hint == 'pip install "hil[x,y]", or do without'
