"""The gallery: every picture is there, small, said in words and made by a command above it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs import gallery
from tests.support import docs_commands

TEXT = gallery.PAGE.read_text("utf-8")
PICTURES = re.findall(r"!\[([^\]]*)\]\(images/gallery/([\w-]+)\.webp\)", TEXT)
COMMANDS = [line for block in docs_commands.blocks(gallery.PAGE) for line in block.commands]
MOST = 2_000_000


def test_every_picture_that_is_made_is_shown_and_every_one_shown_is_made() -> None:
    shown = [name for _, name in PICTURES]
    assert sorted(shown) == sorted(set(shown)) == sorted(gallery.SHOTS)
    assert sorted(path.stem for path in gallery.OUT.iterdir()) == sorted(shown)


def test_the_pictures_are_small_and_whole() -> None:
    files = list(gallery.OUT.iterdir())
    assert sum(file.stat().st_size for file in files) < MOST
    for file in files:
        head = file.read_bytes()[:12]
        assert (head[:4], head[8:]) == (b"RIFF", b"WEBP"), file.name
        assert int.from_bytes(head[4:8], "little") + 8 == file.stat().st_size, file.name


@pytest.mark.parametrize(("said", "name"), PICTURES, ids=[name for _, name in PICTURES])
def test_a_picture_is_said_in_words(said: str, name: str) -> None:
    assert len(said) > 20


def test_every_section_with_pictures_says_the_command_that_makes_them() -> None:
    sections = [part for part in TEXT.split("\n## ")[1:] if "images/gallery" in part]
    assert sections
    assert [part.partition("\n")[0] for part in sections if "```sh\nhil " not in part] == []


@pytest.mark.thorough
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_one_of_hil(command: str) -> None:
    docs_commands.parse(command)


def test_the_dashboard_is_served_for_its_pictures_and_not_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    scripts: list[str] = []
    monkeypatch.setattr(gallery.subprocess, "run", lambda words, **_: scripts.append(words[-1]))
    gallery.run_commands(tmp_path)
    assert gallery.serve_command() in COMMANDS
    assert "hil serve" not in scripts[0]
    assert "hil fleet run" in scripts[0]


def test_pages_of_the_dashboard_are_shown_in_both_themes() -> None:
    served = {name: shot for name, shot in gallery.SHOTS.items() if shot.file.startswith("/")}
    light = {name for name, shot in served.items() if not shot.dark}
    assert {f"{name}-dark" for name in light - {"moving"}} == served.keys() - light
    for name in light - {"moving"}:
        assert served[name].file == served[f"{name}-dark"].file
