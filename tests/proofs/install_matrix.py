"""The wheel in fresh virtual environments: each set of extras under each Python at hand.

    python -m tests.proofs.install_matrix          # everything
    python -m tests.proofs.install_matrix --sets core,ur --pythons 3.11

Builds the wheel, installs it with constraints.txt, runs `install_smoke.py` outside the checkout
and prints a table in Markdown (docs/reference/installing.md keeps one). Exits 1 when a cell fails;
a Python that is not at hand and a set without wheels for one are said, and are no failure. So is
torch where pip finds only builds with CUDA, which are gigabytes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from tests.support.paths import ROOT

SMOKE = Path(__file__).with_name("install_smoke.py")
PYTHONS = ("3.11", "3.12", "3.13")
SETS = {"core": "", "ur": "ur", "can": "can", "web": "web", "learn": "learn"}
"""Name of each set and the extra it stands for."""

NO_WHEELS = {("3.13", "ur"): "ur-rtde has no wheel"}
"""What the markers of pyproject.toml leave out."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One set under one Python: what came of it, and how long and how big the install was."""

    result: str
    seconds: float = 0.0
    megabytes: float = 0.0
    said: str = ""

    @property
    def failed(self) -> bool:
        return self.result == "FAILED"

    def __str__(self) -> str:
        if not self.seconds:
            return self.result
        return f"{self.result}, {self.seconds:.0f} s, {self.megabytes:.0f} MB"


def interpreter(version: str) -> str | None:
    """A Python of this version on the path that really starts, or None."""
    code = "import sys; print(sys.executable, '%d.%d' % sys.version_info[:2])"
    for folder in os.get_exec_path():
        if not (found := shutil.which(f"python{version}", path=folder)):
            continue
        done = subprocess.run([found, "-c", code], capture_output=True, text=True)
        if done.returncode == 0 and done.stdout.split()[-1] == version:
            return done.stdout.split()[0]
    return None


def only_cuda(python: str) -> bool:
    """Whether pip would take a torch with CUDA for this Python; it looks and installs nothing.

    Raises:
        RuntimeError: pip finds no torch at all.
    """
    look = ["install", "--dry-run", "--ignore-installed", "--no-deps", "--report", "-", "--quiet"]
    found = _run([python, "-m", "pip", *look, "-c", str(ROOT / "constraints.txt"), "torch"])
    (torch,) = json.loads(found)["install"]
    return not torch["metadata"]["version"].endswith("+cpu")


def build(folder: Path) -> Path:
    """The wheel of this checkout, made from a copy: what an earlier build left must not get in.

    Raises:
        RuntimeError: It does not build.
    """
    copy = folder / "source"
    for name in ("hil", "drivers", "mock_robot"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, copy)
    _run([sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(copy)])
    (wheel,) = folder.glob("hil-*.whl")
    return wheel


def try_out(python: str, extra: str, wheel: Path, folder: Path) -> Cell:
    """Install the wheel with an extra in a fresh environment, and let it do its work."""
    venv, work = folder / "venv", folder / "work"
    work.mkdir(parents=True)
    before = time.monotonic()
    try:
        _run([python, "-m", "venv", str(venv)])
        what = f"hil[{extra}] @ {wheel.as_uri()}" if extra else str(wheel)
        pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet"]
        _run([*pip, "--disable-pip-version-check", "-c", str(ROOT / "constraints.txt"), what])
        seconds = time.monotonic() - before
        smoke = shutil.copy(SMOKE, work)
        said = _run([str(venv / "bin" / "python"), smoke, *([extra] if extra else [])], cwd=work)
    except RuntimeError as error:
        return Cell("FAILED", said=str(error))
    return Cell("passes", seconds, _bytes(venv) / 1e6, said)


def _run(command: list[str], cwd: Path | None = None) -> str:
    # Tests name the checkout in PYTHONPATH: with it, its modules would stand in for the wheel's.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd or ROOT.parent, env=env)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    return done.stdout


def _bytes(folder: Path) -> int:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file() and not f.is_symlink())


def table(cells: dict[tuple[str, str], Cell], versions: list[str]) -> str:
    """The cells as a table in Markdown, a row per set."""
    lines = ["| | " + " | ".join(f"Python {v}" for v in versions) + " |"]
    lines.append("|---" * (1 + len(versions)) + "|")
    for name in dict.fromkeys(name for name, _ in cells):
        shown = " | ".join(str(cells[name, v]) for v in versions)
        lines.append(f"| `hil{f'[{name}]' if SETS[name] else ''}` | {shown} |")
    return "\n".join(lines)


def matrix(sets: list[str], versions: list[str], folder: Path) -> dict[tuple[str, str], Cell]:
    """Every cell, one after the other; what was tried is removed again."""
    wheel = build(folder / "dist")
    cells: dict[tuple[str, str], Cell] = {}
    for name in sets:
        for version in versions:
            python, place = interpreter(version), folder / f"{name}-{version}"
            if reason := NO_WHEELS.get((version, name)):
                cells[name, version] = Cell(reason)
            elif python is None:
                cells[name, version] = Cell("no interpreter")
            elif name == "learn" and only_cuda(python):
                cells[name, version] = Cell("not tested: only CUDA builds available")
            else:
                cells[name, version] = try_out(python, SETS[name], wheel, place)
                shutil.rmtree(place)
            cell = cells[name, version]
            sys.stderr.write(f"{name} {version}: {cell}\n{cell.said}\n")
    return cells


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", default=",".join(SETS), help="Of: " + ", ".join(SETS))
    parser.add_argument("--pythons", default=",".join(PYTHONS), help="Versions, with commas.")
    given = parser.parse_args()
    versions = given.pythons.split(",")
    with tempfile.TemporaryDirectory(prefix="hil-wheels-") as folder:
        cells = matrix(given.sets.split(","), versions, Path(folder))
    sys.stdout.write(table(cells, versions) + "\n")
    return int(any(cell.failed for cell in cells.values()))


if __name__ == "__main__":
    sys.exit(main())
