"""Documents that commands print with `--json` have every key that revision 48f2337 gave them.

`commands.json` names the commands. They are called one after the other in a copy of the sample,
as they were when their documents were frozen.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from frozen_parts import HERE, command, entered

pytestmark = pytest.mark.timeout(300)  # all commands count as the set-up of the first test

COMMANDS: dict[str, list[str]] = json.loads((HERE / "commands.json").read_text("utf-8"))
SLOW = ("try-out",)
"""Documents of commands that take longer than all the others."""


@pytest.fixture(scope="module")
def documents(
    unpacked: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[int, str]]:
    """What all commands print, one after the other in one copy, as they were frozen."""
    said = {}
    with pytest.MonkeyPatch.context() as patch:
        lab = entered(unpacked, tmp_path_factory.mktemp("documents"), patch)
        for name, words in COMMANDS.items():
            if name not in SLOW:
                given = [found for word in words for found in matching(word, lab)]
                said[name] = command(*given, "--json")
    return said


def matching(word: str, folder: Path) -> list[str]:
    """A word of a command, or the one file that its pattern matches."""
    return [str(f.relative_to(folder)) for f in folder.glob(word)] if "/*" in word else [word]


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in SLOW])
def test_a_document_has_all_its_keys(
    name: str, documents: dict[str, tuple[int, str]], unpacked: Path
) -> None:
    compare(name, *documents[name], unpacked)


@pytest.mark.wire
@pytest.mark.parametrize("name", SLOW)
def test_a_slow_document_has_all_its_keys(name: str, lab: Path) -> None:
    compare(name, *command(*COMMANDS[name], "--json"), lab)


def compare(name: str, code: int, out: str, frozen: Path) -> None:
    """Hold a document against the frozen one: keys may have been added, none may be gone."""
    codes = json.loads((frozen / "json/exit-codes.json").read_text("utf-8"))
    assert code == codes[name] or (name, code) == ("doctor", 1), out  # of this computer
    old = (frozen / f"json/{name}.json").read_text("utf-8")
    assert missing(parsed(old), parsed(out)) == []


def parsed(text: str) -> Any:
    """A document, or a list of them where there is one a line."""
    try:
        return json.loads(text)
    except ValueError:
        return [json.loads(line) for line in text.splitlines()]


def missing(old: Any, new: Any, where: str = "$") -> list[str]:
    """Keys that are gone, and values that are of another kind; null may stand for anything."""
    if old is None or new is None:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        gone = [f"{where}.{key} is gone" for key in old if key not in new]
        return gone + [
            line for key in old if key in new
            for line in missing(old[key], new[key], f"{where}.{key}")
        ]  # fmt: skip
    if isinstance(old, list) and isinstance(new, list):
        if old and not new:
            return [f"{where} is empty"]
        return missing(merged(old), merged(new), f"{where}[]")
    if kind_of(old) != kind_of(new):
        return [f"{where} is {kind_of(new)}, not {kind_of(old)}"]
    return []


def merged(items: list[Any]) -> Any:
    """One item with the keys of all."""
    known = [item for item in items if item is not None]
    if known and all(isinstance(item, dict) for item in known):
        keys = {key for item in known for key in item}
        return {key: merged([item.get(key) for item in known]) for key in keys}
    if known and all(isinstance(item, list) for item in known):
        return [one for item in known for one in item]
    return known[0] if known else None


def kind_of(value: Any) -> str:
    if isinstance(value, bool):
        return "true or false"
    return {dict: "a mapping", list: "a list", str: "text"}.get(type(value), "a number")
