"""Documents that commands print with `--json` have every key that revision 48f2337 gave them.

`commands.json` names the commands. They are called one after the other in a copy of the sample,
as they were when their documents were frozen.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.frozen.frozen_parts import HERE, command, compare, entered

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


@pytest.mark.thorough
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in SLOW])
def test_a_document_has_all_its_keys(
    name: str, documents: dict[str, tuple[int, str]], unpacked: Path
) -> None:
    compare(name, *documents[name], unpacked)


@pytest.mark.proof
@pytest.mark.parametrize("name", SLOW)
def test_a_slow_document_has_all_its_keys(name: str, lab: Path) -> None:
    compare(name, *command(*COMMANDS[name], "--json"), lab)
