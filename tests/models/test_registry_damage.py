"""A log that was emptied, cut, edited or removed is found out, and only `repair` rewrites it."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import RegistryError, exit_code_of
from hil.estimators import estimator
from hil.models.log import ALIASES_FILE, HEAD_FILE, LOG_FILE, append_line
from hil.models.model_registry import Registry
from tests.support.synthetic_motion import moving, nominal

Damage = Callable[[Path], None]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three different models of one arm."""
    home = tmp_path_factory.mktemp("models")
    fits = [estimator("rigid-wls").fit(moving(1, 2, seed), nominal()) for seed in (3, 4, 5)]
    return [fit.save(home / str(k)) for k, fit in enumerate(fits)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, folders: list[Path]) -> Path:
    """v1 and v2, registered and promoted in turn: four lines, and v2 is champion."""
    registry = Registry(tmp_path_factory.mktemp("whole") / "registry")
    for folder in folders[:2]:
        number = registry.register("ur5", folder, {"estimator": "rigid-wls"}).number
        registry.promote("ur5", number, reason="", evidence={}, instead_of=number - 1)
    return registry.root


@pytest.fixture
def home(whole: Path, tmp_path: Path) -> Path:
    """The folder of `ur5` in a registry of its own."""
    return Path(shutil.copytree(whole, tmp_path / "registry")) / "ur5"


@pytest.fixture
def old_home(home: Path) -> Path:
    """The same as written before there was a head: no `head.json`, and lines without numbers."""
    documents = [json.loads(line) for line in lines_of(home)]
    (home / HEAD_FILE).unlink()
    (home / LOG_FILE).unlink()
    before = ""
    for document in documents:
        del document["line"]
        append_line(home / LOG_FILE, document | {"before": before})
        before = hashlib.sha256(lines_of(home)[-1].rstrip(b"\n")).hexdigest()
    return home


def lines_of(home: Path) -> list[bytes]:
    return (home / LOG_FILE).read_bytes().splitlines(keepends=True)


def keep_lines(count: int) -> Damage:
    """Cut the log after so many lines, or so many before its end."""
    return lambda home: void((home / LOG_FILE).write_bytes(b"".join(lines_of(home)[:count])))


def cut_inside_a_line(home: Path) -> None:
    content = (home / LOG_FILE).read_bytes()
    (home / LOG_FILE).write_bytes(content[:-20])


def edit_line(number: int) -> Damage:
    def edit(home: Path) -> None:
        lines = lines_of(home)
        lines[number] = lines[number].replace(b'"reason": ""', b'"reason": "x"')
        (home / LOG_FILE).write_bytes(b"".join(lines))

    return edit


def remove(*names: str) -> Damage:
    def unlink(home: Path) -> None:
        for name in names:
            (home / name).unlink()

    return unlink


def void(_: object) -> None:
    """Drop a value."""


def older_head(home: Path) -> None:
    """Put back the head of the first line, as from a backup."""
    first = hashlib.sha256(lines_of(home)[0].rstrip(b"\n")).hexdigest()
    head = json.loads((home / HEAD_FILE).read_bytes())
    head |= {"lines": 1, "sha256": first, "champion": None, "before": []}
    (home / HEAD_FILE).write_text(json.dumps(head))


def edit_head(home: Path) -> None:
    """Name the wrong champion, with number of lines and digest as they were."""
    head = json.loads((home / HEAD_FILE).read_bytes())
    (home / HEAD_FILE).write_text(json.dumps(head | {"champion": 1, "before": []}))


DAMAGES: dict[str, tuple[Damage, str]] = {
    "emptied": (keep_lines(0), "lines 1 to 4 are missing"),
    "last line deleted": (keep_lines(-1), "line 4 is missing"),
    "last line edited": (edit_line(-1), "jsonl:4 is not the line that was written"),
    "cut inside the last line": (cut_inside_a_line, "line 4 is missing or truncated"),
    "removed": (remove(LOG_FILE), "log.jsonl is missing, with its 4 lines"),
    "removed with the view": (remove(LOG_FILE, ALIASES_FILE), "log.jsonl is missing"),
    "an earlier line edited": (edit_line(1), "jsonl:3 does not follow"),
    "head removed": (remove(HEAD_FILE), "head.json is missing"),
    "head damaged": (lambda home: void((home / HEAD_FILE).write_text("{")), "cannot be read"),
    "roles of the head edited": (edit_head, "head.json: its roles differ from those after line 4"),
    "head of another time": (older_head, "has 4 lines but head.json records 1"),
}
damages = pytest.mark.parametrize(("damage", "words"), DAMAGES.values(), ids=DAMAGES)


def content_of(home: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in home.iterdir() if path.is_file()}


def called(home: Path, *words: object) -> str:
    """Run `hil models` and return what it prints, or raise its error."""
    command = ["models", *map(str, words), "--registry", str(home.parent)]
    done = CliRunner().invoke(app, command)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.output


@damages
def test_check_names_the_damage_and_writes_nothing(damage: Damage, words: str, home: Path) -> None:
    damage(home)
    before = content_of(home)
    with pytest.raises(RegistryError, match=words) as error:
        called(home, "check")
    assert exit_code_of(error.value) == 11
    assert f"hil models repair ur5 --registry {home.parent}" in error.value.hint
    assert content_of(home) == before


@damages
def test_no_writer_goes_on_after_a_damage(
    damage: Damage, words: str, home: Path, folders: list[Path]
) -> None:
    damage(home)
    before, registry = content_of(home), Registry(home.parent)
    for write in (
        lambda: registry.promote("ur5", 1, reason="", evidence={}, instead_of=0),
        lambda: registry.promote("ur5", 1, reason="", evidence={}, instead_of=2),
        lambda: registry.keep("ur5", 1, reason="", evidence={}),
        lambda: registry.roll_back("ur5", reason=""),
        lambda: registry.register("ur5", folders[2], {}),
        lambda: registry.rebuild("ur5"),
    ):
        with pytest.raises(RegistryError, match=words):
            write()
    assert content_of(home) == before
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2"]


@pytest.mark.thorough
@damages
def test_repair_brings_the_champion_back_and_keeps_the_old_files(
    damage: Damage, words: str, home: Path
) -> None:
    damage(home)
    before, registry = content_of(home), Registry(home.parent)
    done = registry.repair("ur5")
    assert done is not None
    assert registry.aliases("ur5").to_dict() == {"champion": 2, "challenger": None, "before": [1]}
    assert content_of(done.aside) == {
        name: before[name] for name in (LOG_FILE, HEAD_FILE, ALIASES_FILE) if name in before
    }
    registered = [one.version for one in registry.log("ur5") if one.event == "registered"]
    assert registered == [1, 2]
    last = registry.log("ur5")[-1]
    assert (last.event, last.version) == ("repaired", 2)
    assert words.split("jsonl")[-1] in last.reason
    assert "all as they were registered" in called(home, "check")
    assert registry.roll_back("ur5", reason="").champion == 1


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (keep_lines(0), "lines that registered v1, v2 are missing"),
        (keep_lines(-1), "aliases.json has champion v2, which no line leads to"),
        (cut_inside_a_line, "aliases.json has champion v2"),
        (remove(LOG_FILE), "lines that registered v1, v2 are missing"),
    ],
)
def test_an_older_registry_is_compared_with_its_view(
    damage: Damage, words: str, old_home: Path
) -> None:
    damage(old_home)
    before, registry = content_of(old_home), Registry(old_home.parent)
    with pytest.raises(RegistryError, match=words):
        called(old_home, "check")
    assert content_of(old_home) == before
    registry.repair("ur5")
    assert registry.aliases("ur5").champion == 2


def test_an_older_registry_adopts_a_head_once(old_home: Path) -> None:
    registry, lines = Registry(old_home.parent), lines_of(old_home)
    assert registry.aliases("ur5").champion == 2  # reading writes nothing
    assert not (old_home / HEAD_FILE).exists()
    called(old_home, "check")
    called(old_home, "check")
    assert lines_of(old_home)[:-1] == lines
    assert [one.event for one in registry.log("ur5")][-2:] == ["promoted", "head-adopted"]
    keep_lines(-1)(old_home)
    with pytest.raises(RegistryError, match="line 5 is missing"):
        registry.aliases("ur5")


def test_a_head_one_behind_is_sound_and_the_next_writer_heals_it(
    home: Path, folders: list[Path]
) -> None:
    """As after a kill between the line and the head."""
    registry, head = Registry(home.parent), (home / HEAD_FILE).read_bytes()
    registry.roll_back("ur5", reason="")
    now = (home / HEAD_FILE).read_bytes()
    (home / HEAD_FILE).write_bytes(head)
    assert registry.aliases("ur5").champion == 1
    called(home, "check")
    assert (home / HEAD_FILE).read_bytes() == now


@pytest.mark.parametrize("fixture", ["home", "old_home"])
def test_a_head_that_was_never_written_is_one_behind(
    fixture: str, request: pytest.FixtureRequest, folders: list[Path]
) -> None:
    """As after a kill between the first line with a number, or the adoption's, and the head."""
    home: Path = request.getfixturevalue(fixture)
    if fixture == "home":
        shutil.rmtree(home)
        Registry(home.parent).register("ur5", folders[0], {})
    else:
        called(home, "check")
    (home / HEAD_FILE).unlink()
    before = lines_of(home)
    called(home, "check")
    assert lines_of(home) == before
    assert (home / HEAD_FILE).exists()


def test_a_torn_append_is_sound(home: Path) -> None:
    """As after a kill inside a write: the head is of the whole lines before it."""
    with (home / LOG_FILE).open("ab") as file:
        file.write(b'{"event": "promoted", "ver')
    registry = Registry(home.parent)
    assert registry.repair("ur5") is None
    assert registry.roll_back("ur5", reason="").champion == 1
    assert [one.event for one in registry.log("ur5")][-1] == "rolled-back"


def test_what_needs_no_log_is_readable_after_a_damage(home: Path) -> None:
    keep_lines(0)(home)
    assert "log damaged" in called(home, "list")
    listed = json.loads(CliRunner().invoke(
        app, ["models", "list", "--json", "--registry", str(home.parent)]
    ).stdout)["models"]  # fmt: skip
    assert listed[0]["champion"] is None
    assert "are missing" in listed[0]["problem"]
    assert "v2" in called(home, "show", "ur5")
    assert '"number": 2' in called(home, "show", "ur5", "v2")
    assert Registry(home.parent).load("ur5", "v2").predict(moving(9)).effort.size
    with pytest.raises(RegistryError, match="are missing"):
        called(home, "show", "ur5", "champion")


def test_a_check_names_every_damaged_name(home: Path, folders: list[Path]) -> None:
    Registry(home.parent).register("lab", folders[0], {})
    Registry(home.parent).register("zoo", folders[0], {})
    for name in ("ur5", "zoo"):
        keep_lines(0)(home.parent / name)
    with pytest.raises(RegistryError, match=r"ur5/log.*zoo/log"):
        called(home, "check")


def test_a_repair_says_what_it_does(home: Path) -> None:
    keep_lines(2)(home)
    said = " ".join(called(home, "repair", "ur5").split())
    assert "lines 3 to 4 are missing" in said
    assert "intact lines: 2; versions added from folders: v2" in said
    assert "champion v2 (from head.json)" in said
    assert "damaged-" in said
    assert "the log is sound, nothing to repair" in called(home, "repair", "ur5")


def test_a_repair_that_is_killed_can_be_repeated(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep_lines(1)(home)
    registry = Registry(home.parent)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hil.models.log._write_head", killed)
        with pytest.raises(KeyboardInterrupt):
            registry.repair("ur5")
    assert registry.problem("ur5") is not None
    registry.repair("ur5")
    assert registry.aliases("ur5").champion == 2


def test_a_repair_without_any_witness_says_that_there_is_no_champion(home: Path) -> None:
    remove(LOG_FILE, HEAD_FILE, ALIASES_FILE)(home)
    assert "no file names a champion" in " ".join(called(home, "repair", "ur5").split())
    assert Registry(home.parent).aliases("ur5").champion == 0


def lose(*numbers: int) -> Damage:
    """Delete the folders of versions."""

    def delete(home: Path) -> None:
        for number in numbers:
            shutil.rmtree(home / f"v{number:04d}")

    return delete


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([2], r"missing version folders .*: v0002 \(champion\)\n"),
        ([1], r"missing version folders .*: v0001\n"),
        ([1, 2], r"missing version folders .*: v0001, v0002 \(champion\)\n"),
    ],
)
@pytest.mark.parametrize("fixture", ["home", "old_home"])
def test_a_lost_version_folder_is_a_problem_and_stops_every_writer(
    numbers: list[int],
    words: str,
    fixture: str,
    request: pytest.FixtureRequest,
    folders: list[Path],
) -> None:
    home: Path = request.getfixturevalue(fixture)
    lose(*numbers)(home)
    before, registry = content_of(home), Registry(home.parent)
    with pytest.raises(RegistryError) as error:
        called(home, "check")
    assert exit_code_of(error.value) == 11
    for write in (
        lambda: registry.register("ur5", folders[2], {}),
        lambda: registry.promote("ur5", 3 - numbers[0], reason="", evidence={}, instead_of=2),
        lambda: registry.roll_back("ur5", reason=""),
        lambda: registry.aliases("ur5"),
    ):
        with pytest.raises(RegistryError):
            write()
    with pytest.raises(RegistryError, match=words):
        registry.aliases("ur5")
    assert content_of(home) == before
    assert "log damaged" in called(home, "list")


def test_a_repair_takes_the_roles_from_lost_versions_and_records_them(
    home: Path, folders: list[Path]
) -> None:
    lose(2)(home)
    said = " ".join(called(home, "repair", "ur5").split())
    assert "versions lost, without a role from here on: v2" in said
    assert "there is no champion: the next promotion is the first" in said
    assert f"make v1 champion again: hil models rollback ur5 --registry {home.parent}" in said
    registry = Registry(home.parent)
    assert registry.log("ur5")[-1].evidence["lost"] == [2]
    assert registry.aliases("ur5").to_dict() == {
        "champion": None, "challenger": None, "before": [1]
    }  # fmt: skip
    assert "all as they were registered" in called(home, "check")
    assert registry.roll_back("ur5", reason="").champion == 1


@pytest.mark.parametrize("numbers", [[2], [1, 2]])
def test_the_number_of_a_lost_version_is_not_used_again(
    numbers: list[int], home: Path, folders: list[Path]
) -> None:
    lose(*numbers)(home)
    registry = Registry(home.parent)
    registry.repair("ur5")
    assert registry.repair("ur5") is None
    assert registry.register("ur5", folders[2], {}).number == 3
    assert registry.aliases("ur5").champion == 0


def test_a_lost_champion_is_recorded_also_if_its_line_is_lost(
    home: Path, folders: list[Path]
) -> None:
    lose(2)(home)
    keep_lines(2)(home)
    registry = Registry(home.parent)
    done = registry.repair("ur5")
    assert done is not None
    assert done.lost == (2,)
    assert registry.register("ur5", folders[2], {}).number == 3


def test_a_lost_version_that_is_restored_after_a_repair_is_entered_again(
    home: Path, tmp_path: Path
) -> None:
    shutil.move(home / "v0002", tmp_path / "v0002")
    registry = Registry(home.parent)
    registry.repair("ur5")
    shutil.move(tmp_path / "v0002", home / "v0002")
    called(home, "check")
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2"]
    assert registry.log("ur5")[-1].to_dict()["event"] == "registered"
    assert registry.aliases("ur5").champion == 0


def test_a_kill_between_folder_and_line_is_no_damage(
    home: Path, folders: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder appears first, so that each line that registers has its folder."""
    registry = Registry(home.parent)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hil.models.model_registry.append", killed)
        with pytest.raises(KeyboardInterrupt):
            registry.register("ur5", folders[2], {})
    assert registry.problem("ur5") is None
    called(home, "check")
    assert [one.version for one in registry.log("ur5") if one.event == "registered"] == [1, 2, 3]


def test_a_repair_counts_the_lines_it_sets_aside(home: Path) -> None:
    lines = lines_of(home)
    (home / LOG_FILE).write_bytes(b"".join([lines[0], b"garbage\n", *lines[2:], b"torn"]))
    said = " ".join(called(home, "repair", "ur5").split())
    aside = next(home.glob("damaged-*"))
    assert f"lines set aside: 4, not in the new log, only in {aside / LOG_FILE}" in said
    assert "champion v2 (from head.json)" in said
