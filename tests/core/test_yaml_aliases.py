"""YAML whose aliases stand for far more than the file holds: every reader refuses it cheaply.

The limits are of processor time and memory, through the public functions, so that they hold
whichever YAML library reads the files.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.arms import load_arm
from hil.cli.app import app
from hil.core.errors import SpecError
from hil.core.yaml import look_into, parse
from hil.estimators.drive_gains import read_gains
from hil.importers.import_map import load_map
from hil.maintenance.fleet_specs import spec_for
from hil.spec.load import load_spec, load_station
from hil.spec.schedule import load_schedule_spec
from hil.spec.series import load_series_spec
from hil.workflow.operator import load_answers
from hil_mock_robot.ur.faults import UrFault

MOST_CPU_S = 0.5
MOST_BYTES = 10e6


def chain(first: str, link: str, levels: int = 9) -> str:
    """Lines of which each uses the one above ten times."""
    lines = [f"a0: &a0 {first}"]
    for level in range(1, levels):
        lines.append(f"a{level}: &a{level} {link.format(', '.join([f'*a{level - 1}'] * 10))}")
    return "\n".join(lines) + "\n"


BOMBS = {
    "lists": chain("[ha, ha, ha, ha, ha, ha, ha, ha, ha, ha]", "[{}]"),
    "merge keys": chain("{k: 1}", "{{<<: [{}]}}"),
    "one long list": f"a: &a [{'1,' * 250}]\nb: [{'*a,' * 100}]\n",
    "one long text": f"a: &a {'x' * 20_000}\nb: [{'*a,' * 100}]\n",
    "levels behind aliases": "a0: &a0 [1]\n"
    + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 110)),
    "brackets": "a: " + "[" * 600,
    "an alias in itself": "a: &a [*a]\n",
}

READERS: dict[str, Callable[[Path], object]] = {
    "spec": load_spec,
    "station": load_station,
    "schedule": load_schedule_spec,
    "series": load_series_spec,
    "spec of a fleet": lambda path: spec_for(path.read_text("utf-8"), str(path), "ur5"),
    "import map": load_map,
    "drive gains": read_gains,
    "answers": load_answers,
    "description of an arm": lambda path: load_arm(str(path)),
    "faults of a mock": UrFault.read,
}


def cost(read: Callable[[], object]) -> float:
    """Return the least processor time of three readings [s]."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        read()
        times.append(time.process_time() - begin)
    return min(times)


def peak(read: Callable[[], object]) -> int:
    """Return the most memory that a reading takes at once [bytes]."""
    tracemalloc.start()
    try:
        read()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def refused(read: Callable[[Path], object], path: Path) -> None:
    with pytest.raises(SpecError, match=r"alias|levels"):
        read(path)


@pytest.mark.thorough
@pytest.mark.parametrize("bomb", BOMBS)
@pytest.mark.parametrize("reader", READERS)
def test_aliases_are_refused_before_they_are_followed(
    tmp_path: Path, reader: str, bomb: str
) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(BOMBS[bomb])
    refused(READERS[reader], path)  # what is imported at first use is no part of the cost

    assert cost(lambda: refused(READERS[reader], path)) <= MOST_CPU_S
    assert peak(lambda: refused(READERS[reader], path)) <= MOST_BYTES


@pytest.mark.thorough
def test_validate_refuses_aliases_as_cheaply_as_it_refuses_any_other_mistake(
    tmp_path: Path,
) -> None:
    bomb, mistake = tmp_path / "bomb.yaml", tmp_path / "mistake.yaml"
    bomb.write_text(BOMBS["lists"])
    mistake.write_text("hil: 1\nname: [\n")

    def validate(path: Path) -> None:
        error = CliRunner().invoke(app, ["validate", str(path)]).exception
        assert isinstance(error, SpecError)

    validate(bomb)
    assert cost(lambda: validate(bomb)) <= cost(lambda: validate(mistake)) + MOST_CPU_S
    assert peak(lambda: validate(bomb)) <= MOST_BYTES


@pytest.mark.thorough
def test_the_most_that_a_short_file_may_stand_for_is_cheap_as_well(tmp_path: Path) -> None:
    """Whatever is let through is bounded too: a file just below the limit."""
    head = f"a: &a [{'1,' * 100}]\nb: "
    times = next(n for n in range(100, 0, -1) if _is_read(f"{head}[{'*a,' * n}]"))
    text = f"{head}[{'*a,' * times}]"
    assert len(text) < 1000

    assert cost(lambda: parse(text, "f")) <= MOST_CPU_S
    assert peak(lambda: parse(text, "f")) <= MOST_BYTES
    assert peak(lambda: look_into(text)) <= MOST_BYTES


def _is_read(text: str) -> bool:
    try:
        parse(text, "f")
    except SpecError:
        return False
    return True


@pytest.mark.parametrize("keys", [0, 60])
def test_aliases_of_a_hundred_robots_are_read(keys: int) -> None:
    """What people use aliases for: one entry of a station, many times."""
    options = "".join(f", k{i}: {i}" for i in range(keys))
    one = f"{{driver: mock, model: ur5, options: {{seed: 1{options}}}, gains: [1, 2, 3, 4, 5, 6]}}"
    text = f"robots:\n  r0: &robot {one}\n" + "".join(f"  r{i}: *robot\n" for i in range(1, 100))

    robots = parse(text, "f").data["robots"]
    assert len(robots) == len(look_into(text)["robots"]) == 100
    assert robots["r99"]["gains"] == [1, 2, 3, 4, 5, 6]
