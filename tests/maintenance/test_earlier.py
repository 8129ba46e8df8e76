"""Which probes of the weeks before a challenger has to err less on, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.maintenance import reidentifying
from hil.maintenance.reidentifying import MOST, earlier_probes
from hil.models.drift import Probe
from hil.models.drift_features import Features
from hil.models.model_registry import Registry


def probe(folder: Path, day: int, champion: int = 1, *, changed: bool = False) -> Probe:
    """Of a day; its recording is a file."""
    source = folder / f"{day:02d}.mcap"
    source.write_bytes(b"")
    nothing = np.zeros(0)
    told = Features((), nothing, nothing, nothing, nothing, 0, np.eye(0), np.zeros((1, 0)))
    at = f"2026-11-{day:02d}T03:00:00+00:00"
    return Probe(
        str(day), at, str(source), "", champion, 0.01, told, changed, (), 0.5, 5
    )  # fmt: skip


@pytest.fixture
def days(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """The days that are looked at, given the history; today is the 28th."""

    def found(*probes: Probe) -> list[str]:
        monkeypatch.setattr(reidentifying, "probes_of", lambda registry, name: list(probes))
        registry = Registry(tmp_path)
        return [path.stem for path in earlier_probes(registry, "ur5", tmp_path / "28.mcap")]

    return found


def test_the_last_ones_before_today_whoever_was_champion(
    tmp_path: Path, days: Callable[..., list[str]]
) -> None:
    history = [probe(tmp_path, day, champion=1 + day // 24) for day in range(20, 29)]
    assert days(*history) == ["27", "26", "25", "24", "23"]
    assert MOST == 5


def test_as_far_back_as_nothing_has_changed(tmp_path: Path, days: Callable[..., list[str]]) -> None:
    history = [probe(tmp_path, day, changed=day == 25) for day in (24, 25, 26, 27, 28)]
    assert days(*history) == ["27", "26"]


def test_one_probe_under_two_champions_is_one_and_changed_if_either_says_so(
    tmp_path: Path, days: Callable[..., list[str]]
) -> None:
    twice = probe(tmp_path, 26)
    again = replace(twice, champion=2)
    assert days(probe(tmp_path, 25), twice, again, probe(tmp_path, 28)) == ["26", "25"]
    changed = replace(twice, champion=2, changed=True)
    assert days(probe(tmp_path, 25), changed, twice, probe(tmp_path, 27)) == ["27"]


def test_what_was_pruned_is_left_out(tmp_path: Path, days: Callable[..., list[str]]) -> None:
    gone, there = probe(tmp_path, 26), probe(tmp_path, 27)
    Path(gone.source).unlink()
    run = tmp_path / "run"
    (run / "recording").mkdir(parents=True)
    assert days(probe(tmp_path, 25), gone, there) == ["27", "25"]
    assert days(replace(gone, source=str(run)), there) == ["27"]
    (run / "recording" / "00.mcap").write_bytes(b"")
    assert days(replace(gone, source=str(run)), there) == ["27", "run"]
