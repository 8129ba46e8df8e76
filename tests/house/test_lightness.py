"""The core stays light: what `import hil` and `hil --help` may not load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import EXPERIMENTS

HEAVY = (
    "torch", "mujoco", "numba", "sklearn", "scipy", "plotly", "pinocchio", "rtde_control",
    "rtde_receive", "can", "canopen", "distributed", "mcap", "foxglove", "matplotlib",
    "starlette", "uvicorn", "playwright", "hil_mock_robot", "hil_drivers",
)  # fmt: skip


def loaded_after(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stderr.split()}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "code",
    [
        "import hil",
        "import hil.cli",
        "from typer.testing import CliRunner\nfrom hil.cli.app import app\n"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0",
    ],
    ids=["import hil", "import hil.cli", "hil --help"],
)
def test_nothing_heavy_is_loaded(code: str) -> None:
    assert loaded_after(code).isdisjoint(HEAVY)


@pytest.mark.thorough
def test_pure_calculation_imports_nothing_that_only_posix_has() -> None:
    absent = "import sys\nfor n in ('fcntl', 'termios', 'resource', 'pwd'): sys.modules[n] = None\n"
    names = ("hil.arms.load_arm", "hil.dynamics.load_model", "hil.estimators.load_model_file",
             "hil.evaluation.evaluate", "hil.control.HandGuiding")  # fmt: skip
    code = "".join(f"from {n.rpartition('.')[0]} import {n.rpartition('.')[2]}\n" for n in names)
    assert "numpy" in loaded_after(f"{absent}{code}import hil.estimators.rigid_linear")


def test_the_api_appears_when_it_is_used() -> None:
    import hil

    assert callable(hil.load)
    assert "load" in dir(hil)
    with pytest.raises(AttributeError, match="frobnicate"):
        hil.frobnicate  # noqa: B018


@pytest.mark.thorough
def test_every_function_of_the_api_works_in_one_script(tmp_path: Path) -> None:
    script = f"""
import hil
experiment = hil.load({str(EXPERIMENTS / "ci_dwell_12.yaml")!r})
plan = hil.plan(experiment)
first = hil.run(experiment, runs={str(tmp_path)!r})
data = hil.dataset(first.run)
fitted = hil.fit([first.run], estimator="static-wls", out={str(tmp_path / "m")!r})
other = hil.run(hil.load({str(EXPERIMENTS / "ci_fourier_2.yaml")!r}), runs={str(tmp_path)!r})
judged = hil.evaluate(fitted.fitted.folder, [other.run])
again = hil.plan(experiment)
assert plan.hash == again.hash
assert len(data) and judged
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
