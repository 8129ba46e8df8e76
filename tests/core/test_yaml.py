"""YAML: values as written, with their places, within bounds of size, time and aliases."""

from __future__ import annotations

import math
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from hil.arms import load_arm
from hil.cli import completion
from hil.cli.app import app
from hil.core.errors import SpecError
from hil.core.yaml import (
    DEEPEST_LOOK,
    MOST_BYTES,
    KeyPath,
    Source,
    as_scalar,
    is_number,
    look_into,
    parse,
    read_source,
    scalar,
    with_value,
    yaml_text,
)
from hil.estimators.drive_gains import read_gains
from hil.importers.import_map import load_map
from hil.maintenance.fleet_specs import spec_for
from hil.spec.load import load_spec, load_station
from hil.spec.schedule import load_schedule_spec
from hil.spec.series import load_series_spec
from hil.workflow.operator import load_answers
from hil_mock_robot.ur.faults import UrFault
from tests.support.fuzzing import ANYTHING, damaged, examples, quick_folder
from tests.support.paths import EXPERIMENTS

# Reading YAML: scalars as YAML 1.2 has them, every mistake at its line and column


def lines_of(text: str | bytes) -> list[str]:
    """What is said about a text, whether it could be parsed or not."""
    try:
        return [str(problem) for problem in parse(text, "f").problems]
    except SpecError as error:
        return error.message.splitlines()


# YAML 1.2.2, example 10.9 and the tables of §10.3.2.
CORE_SCHEMA = [
    ("null", None),
    ("Null", None),
    ("~", None),
    ("", None),
    ("nULL", "nULL"),
    ("true", True),
    ("False", False),
    ("tRUE", "tRUE"),
    ("yes", "yes"),
    ("on", "on"),
    ("Off", "Off"),
    ("n", "n"),
    ("0", 0),
    ("-19", -19),
    ("+12", 12),
    ("012", 12),
    ("0o7", 7),
    ("0o14", 12),
    ("0x3A", 58),
    ("0o8", "0o8"),
    ("0b1", "0b1"),
    ("1_000", "1_000"),
    ("0.", 0.0),
    (".5", 0.5),
    ("-0.0", -0.0),
    ("1e-3", 1e-3),
    ("1E3", 1000.0),
    ("12e03", 12000.0),
    ("-2E+05", -2e5),
    ("1.5e", "1.5e"),
    (".", "."),
    ("-.INF", -math.inf),
    ("+.inf", math.inf),
    ("12:30", "12:30"),
    ("1:2:3", "1:2:3"),
    ("2026-11-21", "2026-11-21"),
    ("=", "="),
    ("'1e-3'", "1e-3"),
    ('"true"', "true"),
    ("!!str 12", "12"),
    ("!!float 1", 1.0),
]


@pytest.mark.parametrize(("text", "value"), CORE_SCHEMA)
def test_a_scalar_means_what_yaml_1_2_says(text: str, value: object) -> None:
    read = parse(f"a: {text}", "f").data["a"]

    assert read == value
    assert type(read) is type(value)


def test_not_a_number_is_a_float() -> None:
    assert math.isnan(scalar(".NaN"))


def test_where_yaml_1_1_and_1_2_agree_pyyaml_reads_the_same() -> None:
    text = "a: [1, 2.5, -3.25e+2, text, 'x', null, true]\nb:\n  c: |\n    lines\n  d: >-\n   x\n"

    assert parse(text, "f").data == yaml.safe_load(text)


# What YAML 1.1 writes without quotes and YAML 1.2 reads as a number, and merge keys, are left out.
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12).filter(
    lambda text: not is_number(text) and not text.startswith("0o") and text != "<<"
)
DOCUMENTS = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(1 - 2**63, 2**63 - 1)
    | st.floats(allow_nan=False)
    | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=15,
)
STYLES = st.fixed_dictionaries(
    {
        "default_flow_style": st.sampled_from([None, True, False]),
        "default_style": st.sampled_from([None, '"', "'", "|", ">"]),
        "allow_unicode": st.booleans(),
        "indent": st.integers(2, 6),
        "width": st.integers(10, 100),
        "explicit_start": st.booleans(),
    }
)


def places(node: yaml.Node, path: KeyPath = ()) -> Iterator[tuple[KeyPath, tuple[int, int]]]:
    """Every value below a node with its line and column."""
    yield path, (node.start_mark.line + 1, node.start_mark.column + 1)
    pairs = node.value if isinstance(node.value, list) else []
    for index, child in enumerate(pairs):
        is_pair = isinstance(child, tuple)
        step, value = (child[0].value, child[1]) if is_pair else (index, child)
        yield from places(value, (*path, step))


@examples(100)
@given(DOCUMENTS, STYLES)
def test_whatever_pyyaml_writes_is_read_as_pyyaml_reads_it(
    document: Any, style: dict[str, Any]
) -> None:
    """Where the versions of YAML agree: the data, and where every value stands."""
    text = yaml.safe_dump(document, **style)

    source = parse(text, "f")

    assert not source.problems
    assert repr(source.data) == repr(yaml.safe_load(text))
    found = {path: mark[1:] for path, mark in source.values.items()}
    assert found == dict(places(yaml.compose(text, Loader=yaml.SafeLoader)))


@examples(100)
@given(DOCUMENTS)
def test_both_readers_agree_about_documents_that_are_quoted(document: Any) -> None:
    text = yaml.safe_dump(document, default_style='"')

    assert repr(parse(text, "f").data) == repr(look_into(text))


ANY_TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
ODD_TEXT = st.sampled_from(["12e4", "0o17", "1_0", "12:30", "yes", "~", "", "2026-11-21", "a: b"])


@examples(100)
@given(st.dictionaries(TEXTS, st.lists(ANY_TEXT | ODD_TEXT, max_size=4), max_size=4), st.booleans())
def test_text_that_is_written_is_text_to_both_readers(
    document: dict[str, list[str]], block: bool
) -> None:
    text = yaml_text(document, block=block)

    assert parse(text, "f").data == look_into(text) == document


def test_keys_such_as_on_and_y_are_text() -> None:
    assert parse("on: 1\ny: 2\nno: 3", "f").data == {"on": 1, "y": 2, "no": 3}


def test_an_anchor_is_one_value_in_several_places() -> None:
    source = parse("a: &p [1, 2]\nb: *p\n", "f")

    assert source.data == {"a": [1, 2], "b": [1, 2]}
    assert source.data["a"] is not source.data["b"]
    assert source.mark(("b", 1)) == ("f", 1, 11)


PLACES = """\
# a comment
hil: 1
robot:   "ur5"   # and another

loads:
- {mass_kg: 0, "käfig": [a,
     b]}
- mass_kg: 3
  com_m: &c [0, 0, 0.05]
  again: *c
text: |
  two
  lines
nothing:
? asked
: told
"""


@pytest.mark.parametrize(
    ("path", "key", "value"),
    [
        ((), None, (2, 1)),
        (("hil",), (2, 1), (2, 6)),
        (("robot",), (3, 1), (3, 10)),
        (("loads",), (5, 1), (6, 1)),
        (("loads", 0), None, (6, 3)),
        (("loads", 0, "mass_kg"), (6, 4), (6, 13)),
        (("loads", 0, "käfig"), (6, 16), (6, 25)),
        (("loads", 0, "käfig", 1), None, (7, 6)),
        (("loads", 1), None, (8, 3)),
        (("loads", 1, "com_m"), (9, 3), (9, 10)),
        (("loads", 1, "com_m", 2), None, (9, 20)),
        (("loads", 1, "again"), (10, 3), (9, 10)),
        (("text",), (11, 1), (11, 7)),
        (("nothing",), (14, 1), (14, 9)),
        (("asked",), (15, 3), (16, 3)),
    ],
)
def test_every_key_and_value_has_its_place(
    path: KeyPath, key: tuple[int, int] | None, value: tuple[int, int]
) -> None:
    source = parse(PLACES, "f")

    assert source.mark(path) == ("f", *value)
    assert source.mark(path, key=True) == ("f", *(key or value))


MISTAKES = [
    ("a: [1, 2", "f:1:9: a ',' or ']' is missing before this"),
    ("a: {b: 1", "f:1:9: a ',' or '}' is missing before this"),
    ("a: 'x\nb: 1", "f:1:4: a quotation mark is opened here and never closed"),
    ("a: 1\nb: c: d", "f:2:5: unexpected ':': put text that contains ': ' in quotes"),
    ("a: 1\n b: 2", "f:2:3: this line is indented differently from the line above"),
    ("a:\n b: 1\n  c: 2", "f:3:4: this line is indented differently from the line above"),
    ("a:\n b: 1\n\n  c: 2", "f:4:4: this line is indented differently from the line above"),
    ("- a\n  b: 2", "f:2:4: unexpected ':': put text that contains ': ' in quotes"),
    ("a:\n\t- 1", "f:2:1: unexpected tab: indent YAML with spaces"),
    ("a:\n  - b\n - c", "f:3:2: this continues no entry above: check the indentation"),
    ("a: 1\nword\nc: 2", "f:2:1: this is neither a key with ':' nor the value of a key"),
    ("a: *x", "f:1:4: the alias refers to an anchor that is not defined above"),
    ("a: &x 1\nb: &x 2", "f:2:4: the anchor is defined a second time"),
    ("a: @x", "f:1:4: text cannot begin with this character: put it in quotes"),
    ("a: 1\n---\nb: 2", "f:2:1: second document: write only one per file and remove the '---'"),
    ("a: {b: }, c", "f:1:9: this continues no entry above: check the indentation"),
    ("[a] b", "f:1:5: this continues no entry above: check the indentation"),
    ('a: "\\UFFFFFFFF"', "f:1:7: the escape or the number here is out of range"),
    ("x: \x01", "f:1:4: the character U+0001 is not allowed in YAML"),
    ("", "f:1:1: the file is empty"),
    ("# only a comment\n", "f:1:1: the file is empty"),
    ("&a [*a]", "f:1:5: an alias contains itself"),
    ("a: " + "[" * 60, "f:1:43: more than 40 levels"),
    (b"a: 1\nb: \xff", "f:2:4: byte 0xff is not UTF-8: save the file as UTF-8"),
    ("a: 1\nb: 2\na: 3", "f:3:1: a: occurs twice, first at line 1, column 1"),
    ("l: [{x: 1, x: 2}]", "f:1:12: l.0.x: occurs twice, first at line 1, column 6"),
    ("a: !!python/name:os.system x", None),
    ("a: !mine x", "f:1:4: a: the tag !mine is not allowed: a spec is plain data"),
    ("a: !!binary eA==", "f:1:4: a: the tag !!binary is not allowed: a spec is plain data"),
    ("a: !!set {b}", "f:1:4: a: the tag !!set is not allowed: a spec is plain data"),
    ("a: !!int x", "f:1:4: a: x is not of type int, which its tag states"),
    ("a: 99999999999999999999", "f:1:4: a: the number is too large"),
    ("a: " + "9" * 5000, "f:1:4: a: the number is too large"),
    ("? [a]\n: 1", "f:1:3: a list or mapping cannot be a key"),
    (
        "1: x",
        "f:1:1: the key '1' is not text: put it in quotes; write a decimal point, not a comma",
    ),
    ("true: x", "f:1:1: the key 'true' is not text: put it in quotes"),
    ("a: {<<: {b: 1}}", "f:1:5: a: merge keys (<<) are not part of YAML 1.2: write the keys out"),
    ('a: "\\uD800"', "f:1:4: a: the text contains half a character (a lone surrogate)"),
]


@pytest.mark.parametrize(("text", "line"), MISTAKES)
def test_a_mistake_is_reported_at_its_place(text: str | bytes, line: str | None) -> None:
    said = lines_of(text)

    if line is None:
        assert "the tag !!python/name:os.system is not allowed" in said[0]
    else:
        assert said == [line]


def test_several_duplicates_and_tags_are_reported_together() -> None:
    assert lines_of("a: 1\na: 2\nb: !x 1\nb: 3\n") == [
        "f:2:1: a: occurs twice, first at line 1, column 1",
        "f:3:4: b: the tag !x is not allowed: a spec is plain data",
        "f:4:1: b: occurs twice, first at line 3, column 1",
    ]


def test_aliases_that_blow_up_are_refused() -> None:
    laughs = ["a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    laughs += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]

    with pytest.raises(SpecError, match="aliases expand to more values than a file of this size"):
        parse("\n".join(laughs), "f")


def test_aliases_of_a_long_text_are_counted_by_its_length() -> None:
    text = f"a: &a {'x' * 50_000}\nb: [{', '.join(['*a'] * 100)}]"

    with pytest.raises(SpecError, match="aliases expand"):
        parse(text, "f")


def test_a_byte_order_mark_is_no_part_of_the_first_key() -> None:
    assert parse(b"\xef\xbb\xbfa: 1", "f").data == {"a": 1}


def test_a_file_beyond_the_size_limit_is_not_even_parsed(tmp_path: Path) -> None:
    file = tmp_path / "poses.yaml"
    file.write_text("[" + "1," * MOST_BYTES)

    with pytest.raises(SpecError, match="is larger than 256 KiB") as caught:
        read_source(file)
    assert "excitation.file" in caught.value.hint


def test_a_misspelt_file_name_is_guessed(tmp_path: Path) -> None:
    (tmp_path / "ur5_dwell.yaml").write_text("a: 1")

    with pytest.raises(SpecError, match=r"ur5_dwel\.yaml: there is no such file") as caught:
        read_source(tmp_path / "ur5_dwel.yaml")
    assert caught.value.hint == f"did you mean {tmp_path / 'ur5_dwell.yaml'}?"


@pytest.mark.parametrize("name", ["", "no/such/folder/a.yaml", "a\0b.yaml"])
def test_an_unreadable_path_is_a_spec_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(SpecError):
        read_source(tmp_path / name)


def test_the_place_of_something_missing_is_that_of_what_surrounds_it() -> None:
    source: Source = parse("a:\n  b: {c: 1}\n", "f")

    assert source.mark(("a", "b", "nothing", 3)) == ("f", 2, 6)
    assert source.mark(("a", "b"), key=True) == ("f", 2, 3)


def test_a_value_on_the_command_line_is_yaml_as_well() -> None:
    assert scalar("[4, 20, 1e-3, on]") == [4, 20, 1e-3, "on"]
    assert scalar(" ") is None
    with pytest.raises(SpecError, match=r"value:1:1: the tag !x"):
        scalar("!x 1")
    with pytest.raises(SpecError, match="value: is larger than 256 KiB"):
        scalar("x" * (MOST_BYTES + 1))


def test_another_value_leaves_all_else_as_written() -> None:
    text = "# mine\nrobot:  'ur5' # ours\nloads: [{robot: x}]\n"

    assert with_value(text, "robot", '"b"') == text.replace("'ur5'", '"b"')
    assert with_value(text, "loads", "1") is with_value("[robot]", "robot", "1") is None
    with pytest.raises(ValueError, match="found undefined alias"):
        with_value("robot: *x", "robot", "1")


# YAML whose aliases stand for far more than the file holds: every reader refuses it cheaply


MOST_CPU_S = 0.5
MOST_BYTES_OF_ALIASES = 10e6


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
    assert peak(lambda: refused(READERS[reader], path)) <= MOST_BYTES_OF_ALIASES


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
    assert peak(lambda: validate(bomb)) <= MOST_BYTES_OF_ALIASES


@pytest.mark.thorough
def test_the_most_that_a_short_file_may_stand_for_is_cheap_as_well(tmp_path: Path) -> None:
    """Whatever is let through is bounded too: a file just below the limit."""
    head = f"a: &a [{'1,' * 100}]\nb: "
    times = next(n for n in range(100, 0, -1) if _is_read(f"{head}[{'*a,' * n}]"))
    text = f"{head}[{'*a,' * times}]"
    assert len(text) < 1000

    assert cost(lambda: parse(text, "f")) <= MOST_CPU_S
    assert peak(lambda: parse(text, "f")) <= MOST_BYTES_OF_ALIASES
    assert peak(lambda: look_into(text)) <= MOST_BYTES_OF_ALIASES


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


# YAML that is only looked at


LINKED = "- &a0 [x]\n" + "".join(f"- &a{i} [*a{i - 1}]\n" for i in range(1, 200))
LAUGHS = "a0: &a0 {k: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    "text",
    [
        "a: [1", b"a: \xff", "!!python/object/apply:os.getcwd []", "a: \x00", "a: \ud800",
        '!!int ""', "!!bool x", "!!timestamp x", "a: 2020-02-30", "[a]: 1", "=", "[" * 5000,
        "- " * 5000, LINKED, LAUGHS, "&a [*a]",
    ],
)  # fmt: skip
def test_what_is_no_document_is_one_kind_of_error(text: str | bytes) -> None:
    for compiled in (True, False):
        with pytest.MonkeyPatch.context() as patch:
            if not compiled:
                patch.delattr(yaml, "CSafeLoader", raising=False)
            with pytest.raises(ValueError, match="YAML"):
                look_into(text)


def test_brackets_without_end_do_not_end_the_process() -> None:
    code = (
        "from hil.core.yaml import look_into\n"
        "for text in ('[' * 60000, '[' * 60000 + ']' * 60000, '{a: ' * 60000, '- ' * 60000):\n"
        "    try: look_into(text)\n"
        "    except ValueError as error: assert 'more than 100 levels' in str(error), error\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_people_write_is_read() -> None:
    assert look_into("a: &a [1]\nb: *a\nc: {<<: {d: 2}}") == {"a": [1], "b": [1], "c": {"d": 2}}
    deep = look_into("[" * DEEPEST_LOOK + "]" * DEEPEST_LOOK)
    assert str(deep) == "[" * DEEPEST_LOOK + "]" * DEEPEST_LOOK


def test_files_from_elsewhere_are_refused_however_deep(tmp_path: Path) -> None:
    deep = tmp_path / "deep.yaml"
    deep.write_text("[" * 5000)
    said = r"deep\.yaml: .*more than 100 levels"
    with pytest.raises(SpecError, match=said):
        load_arm(str(deep))
    with pytest.raises(SpecError, match=said):
        UrFault.read(deep)
    with pytest.raises(SpecError, match=said):
        spec_for(deep.read_text(), str(deep), "ur5")
    assert as_scalar("[" * 5000).startswith('"[')


def test_robots_of_a_station_that_is_none_are_not_offered(tmp_path: Path) -> None:
    station = tmp_path / "station.yaml"
    station.write_bytes(b"robots: {one: 1}")
    context = SimpleNamespace(params={"station": station})
    complete = completion._completion_of(completion.BY_NAME["robot"])
    assert complete(context, "") == ["one"]
    station.write_bytes(b"robots: {\xff: 1}")
    assert complete(context, "") == []


# Specs, stations and import maps that were right once: a document or a refusal, quickly


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
