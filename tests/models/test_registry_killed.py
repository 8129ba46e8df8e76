"""kill -9 at random moments, several writers at once: what was said to be done is done."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.estimators import estimator
from hil.models.log import Aliases, read_log
from hil.models.model_registry import Registry
from hil.models.version import numbers_in
from tests.support.paths import FILES
from tests.support.synthetic_motion import moving, nominal

KILLS = 8
WRITER = FILES / "registry_writer.py"


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    home = tmp_path_factory.mktemp("models")
    fits = [estimator("rigid-wls").fit(moving(1, 2, seed), nominal()) for seed in (3, 4, 5, 6)]
    return [fit.save(home / str(k)) for k, fit in enumerate(fits)]


@pytest.mark.thorough
def test_nothing_that_was_done_is_undone_by_a_kill(models: list[Path], tmp_path: Path) -> None:
    dice, root = random.Random(7), tmp_path / "registry"
    for kill in range(KILLS):
        writers = [_writer(root, 100 * kill + k, models) for k in range(2)]
        time.sleep(dice.uniform(0.0, 0.25))
        said = [_killed(writer) for writer in writers]
        _consistent(root, said)


def _writer(root: Path, seed: int, models: list[Path]) -> subprocess.Popen[str]:
    command = [sys.executable, str(WRITER), str(root), str(seed), *map(str, models)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    return writer


def _killed(writer: subprocess.Popen[str]) -> list[str]:
    assert writer.poll() is None, "it ended by itself"
    writer.kill()
    said, _ = writer.communicate(timeout=20)
    return [line for line in said.split("\n")[:-1] if line]


def _consistent(root: Path, said: list[list[str]]) -> None:
    home, registry = root / "arm", Registry(root)
    if not numbers_in(home):
        assert not any(said)
        return
    log = read_log(home)  # every line whole, and behind the one before it
    done = [f"{entry.event} {entry.version}" for entry in log]
    for lines in said:
        # In the order in which it was said, all of it is there.
        deeds = iter(done)
        missing = [line for line in lines if line.split()[0] != "registered" and line not in deeds]
        assert not missing
    registry.rebuild("arm")
    versions = registry.versions("arm")
    assert [version.number for version in versions] == list(range(1, len(versions) + 1))
    assert len({version.digest for version in versions}) == len(versions)
    for version in versions:
        version.verify()
    entered = [one.version for one in read_log(home) if one.event == "registered"]
    assert sorted(entered) == [version.number for version in versions]
    now = Aliases.after(read_log(home))
    assert now == registry.aliases("arm")
    assert now.champion in (0, *entered)
    assert registry.register("arm", versions[0].folder, {}).number == 1
