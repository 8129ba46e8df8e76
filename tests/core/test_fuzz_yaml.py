"""Specs, stations and import maps that were right once: a document or a refusal, quickly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hil.core.errors import SpecError
from hil.core.yaml import parse
from hil.importers.import_map import load_map
from hil.spec import load_spec, load_station
from hil.spec.series import load_series_spec
from tests.support.fuzzing import ANYTHING, damaged, examples, quick_folder
from tests.support.paths import EXPERIMENTS

ROOT = EXPERIMENTS
Load = Callable[[Path], object]


def shipped(pattern: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted(ROOT.glob(pattern))]


KINDS: dict[str, tuple[list[bytes], Load]] = {
    "spec": (shipped("*.yaml"), load_spec),
    "station": (shipped("stations/*.yaml"), load_station),
    "series": ([text for text in shipped("*.yaml") if b"\nhil_series:" in text], load_series_spec),
    "map": (shipped("maps/*.yaml"), load_map),
}
kinds = pytest.mark.parametrize("kind", sorted(KINDS))


def refusal(content: bytes, load: Load) -> list[str]:
    """The lines of the SpecError that loading ends with; none where it succeeds."""
    with quick_folder() as folder:
        path = folder / "f.yaml"
        path.write_bytes(content)
        try:
            load(path)
        except SpecError as error:
            lines = str(error).partition("\n  →")[0].replace(str(folder) + "/", "").splitlines()
            assert lines
            assert all(line.startswith(("f.yaml:", "… and ")) for line in lines), lines
            return lines
    return []


def as_yaml(document: Any) -> bytes:
    text: str = yaml.safe_dump(document, allow_unicode=True)
    return text.encode("utf-8", "surrogatepass")


@pytest.mark.thorough
@kinds
@examples(30)
@given(data=st.data())
def test_damaged_document(kind: str, data: st.DataObject) -> None:
    texts, load = KINDS[kind]
    documents = [parse(text, "f").data for text in texts]
    refusal(as_yaml(data.draw(damaged(documents))), load)


@kinds
@examples(15)
@given(data=st.data())
def test_any_document_in_its_place(kind: str, data: st.DataObject) -> None:
    refusal(as_yaml(data.draw(ANYTHING)), KINDS[kind][1])


@pytest.mark.thorough
@kinds
@examples(25)
@given(data=st.data())
def test_text_with_bytes_replaced(kind: str, data: st.DataObject) -> None:
    texts, load = KINDS[kind]
    text = data.draw(st.sampled_from(texts))
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(start + 20, len(text))))
    refusal(text[:start] + data.draw(st.binary(max_size=12)) + text[end:], load)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "content",
    [
        BOMB,
        "a: &a [*a]\n",
        "[" * 100_000,
        "{a: " * 50_000,
        "- " * 100_000,
        "a:\n" + "".join(" " * i + "b:\n" for i in range(1, 600)),
        "&a " * 1000,
        "? " * 5000,
        "!!python/object/apply:os.system [true]\n",
        "x: " + "9" * 200_000,
        "x: 1e" + "9" * 1000,
        "'" * 200_001,
        "a: |\n" + " x\n" * 60_000,
        "\ufeff" * 1000,
        "%YAML " + "9" * 5000 + ".1\n---\n",
        "- &a" + "\n- *a" * 60_000,
        "a" * 300_000,
    ],
    ids=lambda text: text[:12].replace("\n", " "),
)
def test_what_was_made_to_break_a_parser(content: str) -> None:
    assert refusal(content.encode(), load_spec)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"2:7"', '"1:99999999999"'),
        ('"2:7"', '"7:2"'),
        ('"2:7"', f'"1:{"9" * 5000}"'),
        ('"2:7"', '"0:5"'),
        ("635:3510", "9:2"),
        ("635:3510", "1:" + "9" * 5000),
        ("635:3510", "١:٢"),
    ],
    ids=lambda text: text[:30],
)
def test_ranges_of_a_map_that_are_none(old: str, new: str) -> None:
    text = (ROOT / "maps" / "ur10e_columns.yaml").read_text("utf-8")
    assert old in text
    assert len(refusal(text.replace(old, new, 1).encode(), load_map)) == 1


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("ci_fourier_2", "fundamental_hz: 0.2", "fundamental_hz: 1e-9"),
        ("ci_fourier_2", "fundamental_hz: 0.2", "fundamental_hz: 1e300"),
        ("ci_fourier_2", "fundamental_hz: 0.2", "fundamental_hz: 0.01\n  periods: 1000"),
        ("ci_fourier_2", "fundamental_hz: 0.2", "fundamental_hz: 1e400"),
        ("ci_dwell_12", "waypoints: 12", "waypoints: 1000000000000"),
        ("ci_dwell_12", "waypoints: 12", "waypoints: 1e400"),
        ("ci_dwell_12", "dwell_s: 0.095", "dwell_s: 1e12"),
        ("ci_dwell_12", "samples_per_dwell: 10", "samples_per_dwell: 10000000"),
        ("ci_dwell_12", "waypoints: 12", "waypoints: 12\n  settle_timeout_s: 1e300"),
        ("ci_dwell_12", "excitation:", "record: {rotate_mb: 1e400}\nexcitation:"),
        ("ci_dwell_12", "duration_s: 5", "duration_s: 1e12"),
        ("ci_dwell_12", "robot:", "loads: [{mass_kg: 1, com_m: [1e300, 0, 0]}]\nrobot:"),
    ],
    ids=lambda text: text[-24:].replace("\n", " "),
)
def test_programs_without_a_sensible_end_are_refused_before_anything_is_planned(
    name: str, old: str, new: str
) -> None:
    text = (ROOT / f"{name}.yaml").read_text("utf-8")
    assert old in text
    assert len(refusal(text.replace(old, new, 1).encode(), load_spec)) == 1
