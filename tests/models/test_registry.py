"""Versions never change, the log only grows, and there is always a way back."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import DataError, RegistryError
from hil.estimators import estimator
from hil.models.log import ALIASES_FILE, HEAD_FILE, LOG_FILE, Entry, append, read_log
from hil.models.model_registry import Registry
from hil.models.version import folder_of
from tests.support.synthetic_motion import moving, nominal


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three different models of one arm."""
    home = tmp_path_factory.mktemp("models")
    fits = [estimator("rigid-wls").fit(moving(1, 2, seed), nominal()) for seed in (3, 4, 5)]
    return [fit.save(home / str(k)) for k, fit in enumerate(fits)]


@pytest.fixture
def registry(tmp_path: Path, folders: list[Path]) -> Registry:
    made = Registry(tmp_path / "registry")
    for folder in folders:
        made.register("ur5", folder, {"estimator": "rigid-wls"})
    return made


@pytest.fixture
def fourth(tmp_path: Path) -> Path:
    """A model that is not registered yet."""
    return estimator("rigid-wls").fit(moving(1, 2, 6), nominal()).save(tmp_path / "fourth")


def promoted(registry: Registry, number: int) -> None:
    registry.promote(
        "ur5", number, reason="", evidence={}, instead_of=registry.aliases("ur5").champion
    )


def test_versions_are_numbered_and_say_what_they_are(registry, folders) -> None:
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2", "v3"]
    assert registry.names() == ["ur5"]
    data = moving(9)
    kept = registry.load("ur5", "v2").predict(data).effort
    fresh = estimator("rigid-wls").fit(moving(1, 2, 4), nominal()).predict(data).effort
    assert np.array_equal(kept, fresh)


def test_the_same_model_twice_is_one_version(registry, folders) -> None:
    assert registry.register("ur5", folders[1], {}).number == 2
    assert len(registry.versions("ur5")) == 3


def test_rolling_back_restores_predictions_bit_for_bit(registry) -> None:
    promoted(registry, 1)
    before = registry.load("ur5").predict(moving(9)).effort
    promoted(registry, 3)
    assert not np.array_equal(registry.load("ur5").predict(moving(9)).effort, before)
    assert registry.roll_back("ur5", reason="worse on the line").champion == 1
    assert np.array_equal(registry.load("ur5").predict(moving(9)).effort, before)


def test_going_back_twice_does_not_come_forward_again(registry) -> None:
    for number in (1, 2, 3):
        promoted(registry, number)
    assert registry.roll_back("ur5", reason="").champion == 2
    assert registry.roll_back("ur5", reason="").champion == 1
    with pytest.raises(RegistryError, match="was no other"):
        registry.roll_back("ur5", reason="")
    promoted(registry, 3)
    assert registry.roll_back("ur5", reason="", to=1).champion == 1


def test_a_challenger_is_one_until_it_is_promoted_or_not(registry, folders) -> None:
    promoted(registry, 1)
    registry.register("ur5", folders[1], {}, challenger=True)
    assert registry.aliases("ur5").challenger == 2
    assert registry.version("ur5", "challenger").number == 2
    registry.keep("ur5", 2, reason="errs more", evidence={})
    assert registry.aliases("ur5").challenger == 0
    registry.register("ur5", folders[2], {}, challenger=True)
    promoted(registry, 3)
    assert registry.aliases("ur5").to_dict() == {"champion": 3, "challenger": None, "before": [1]}
    registry.register("ur5", folders[2], {}, challenger=True)
    assert registry.aliases("ur5").challenger == 0


def test_who_compared_with_another_champion_does_not_promote(registry) -> None:
    promoted(registry, 1)
    promoted(registry, 2)
    with pytest.raises(RegistryError, match="v2 has become champion meanwhile"):
        registry.promote("ur5", 3, reason="", evidence={}, instead_of=1)


def test_what_was_changed_is_not_loaded(registry) -> None:
    path = registry.version("ur5", "v1").folder / "model.json"
    path.chmod(0o644)
    path.write_text(path.read_text("utf-8").replace('"samples": ', '"samples": 1'), "utf-8")
    with pytest.raises(RegistryError, match=r"model\.json is not the file that was registered"):
        registry.load("ur5", "v1")
    with pytest.raises(RegistryError, match="not the file"):
        promoted(registry, 1)


def test_a_line_that_a_crash_has_torn_is_none(registry, tmp_path: Path) -> None:
    promoted(registry, 1)
    log = registry.root / "ur5" / LOG_FILE
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"event": "promoted", "version": 2, "at"')
    assert registry.aliases("ur5").champion == 1
    promoted(registry, 3)
    assert log.read_bytes().startswith(whole)
    assert registry.aliases("ur5").champion == 3


def test_a_log_that_was_changed_is_found_out(registry) -> None:
    promoted(registry, 1)
    promoted(registry, 2)
    log = registry.root / "ur5" / LOG_FILE
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:-2] + lines[-1:]))
    with pytest.raises(RegistryError, match=r"log.jsonl:4 does not follow the line before"):
        registry.aliases("ur5")
    log.write_bytes(b"".join([*lines[:-1], b"{}\n"]))
    with pytest.raises(RegistryError, match=r"log.jsonl:5: damaged"):
        registry.aliases("ur5")


def test_views_are_made_from_files(registry) -> None:
    promoted(registry, 2)
    home = registry.root / "ur5"
    (home / ALIASES_FILE).unlink()
    assert registry.rebuild("ur5").champion == 2
    assert json.loads((home / ALIASES_FILE).read_bytes())["champion"] == 2


def test_a_version_that_the_log_does_not_know_is_entered(registry, fourth: Path) -> None:
    """As after a crash between the folder and the line."""
    home = registry.root / "ur5"
    before = {name: (home / name).read_bytes() for name in (LOG_FILE, HEAD_FILE)}
    version = registry.register("ur5", fourth, {})
    for name, content in before.items():
        (home / name).write_bytes(content)
    promoted(registry, version.number)
    events = [(entry.event, entry.version) for entry in registry.log("ur5")]
    assert events[-2:] == [("registered", 4), ("promoted", 4)]


def test_many_writers_at_once_lose_nothing(registry, folders) -> None:
    def work(k: int) -> None:
        registry.register("lab", folders[k % 3], {}, challenger=True)
        registry.register(f"own-{k}", folders[k % 3], {})

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(6)))
    assert len(registry.versions("lab")) == 3
    assert sum(entry.event == "registered" for entry in registry.log("lab")) == 3
    assert len(registry.names()) == 8


def test_an_entry_comes_back_as_it_was(tmp_path: Path) -> None:
    entry = Entry("kept", 2, "2026-01-01T00:00:00+00:00", "a\nb", "é \u2028", {"x": [1.5, None]})
    append(tmp_path, entry)
    assert read_log(tmp_path) == (entry,)


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "x" * 70, "ur 5"])
def test_a_name_that_is_no_folder_is_refused(name: str, tmp_path: Path, folders) -> None:
    with pytest.raises(RegistryError, match="cannot be the name"):
        Registry(tmp_path).register(name, folders[0], {})


@pytest.mark.parametrize(
    ("which", "words"),
    [("champion", "no champion"), ("v7", "no version 7"), ("newest", "is no version")],
)
def test_versions_that_are_not_there(which: str, words: str, registry) -> None:
    with pytest.raises(RegistryError, match=words):
        registry.version("ur5", which)


def test_slips_are_told(registry, tmp_path: Path) -> None:
    with pytest.raises(RegistryError) as error:
        registry.versions("ur6")
    assert error.value.hint == "there is ur5: hil models list"  # another number, another robot
    with pytest.raises(RegistryError) as error:
        registry.versions("urr5")
    assert error.value.hint == "did you mean 'ur5'?"
    with pytest.raises(DataError, match="no model folder"):
        registry.register("ur5", tmp_path, {})
    assert not folder_of(registry.root / "ur5", 4).exists()
