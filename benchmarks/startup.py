"""How quickly `hil` starts, beside an empty Python and `import numpy`."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

REPEATS, QUICK_REPEATS = 20, 3

COMPLETING = {"_HIL_COMPLETE": "complete_bash", "COMP_WORDS": "hil show 0", "COMP_CWORD": "2"}
"""What a shell asks with."""

STARTS: dict[str, tuple[list[str], dict[str, str]]] = {
    "python": (["-c", "pass"], {}),
    "import_numpy": (["-c", "import numpy"], {}),
    "import_hil": (["-c", "import hil"], {}),
    "hil_version": (["-m", "hil", "--version"], {}),
    "hil_help": (["-m", "hil", "--help"], {}),
    "completion": (["-m", "hil"], COMPLETING),
}
"""Of each: arguments of Python, and what is added to the environment."""


def run(quick: bool = False) -> dict[str, Any]:
    """Median wall time of each start; the starts take turns, so that all see the same computer.

    Args:
        quick: Fewer repetitions.
    """
    took: dict[str, list[float]] = {name: [] for name in STARTS}
    with tempfile.TemporaryDirectory() as folder:  # a completion finds nothing there
        for number in range(1 + (QUICK_REPEATS if quick else REPEATS)):
            for name, (arguments, added) in STARTS.items():
                seconds = _start(arguments, added, folder)
                if number:  # the first fills the caches
                    took[name].append(seconds)
    median = {name: statistics.median(times) for name, times in took.items()}
    ours = [name for name in STARTS if name not in ("python", "import_numpy")]
    ratios = {f"{name}_vs_python": median[name] / median["python"] for name in ours}
    ratios |= {f"{name}_vs_import_numpy": median[name] / median["import_numpy"] for name in ours}
    figures = {f"{name}_ms": 1e3 * seconds for name, seconds in median.items()}
    return {"name": "startup", "figures": figures, "ratios": ratios}


def _start(arguments: list[str], added: dict[str, str], folder: str) -> float:
    environment = {**os.environ, **added}
    before = time.perf_counter()
    subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return time.perf_counter() - before
