"""The page on the CAN bus: its examples run, and it names every file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.canbus_parts import can_channel  # noqa: F401
from tests.support.paths import DOCS, ROOT

PAGE = (DOCS / "reference" / "can-bus.md").read_text("utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_examples_do_what_the_page_says(
    can_channel: str,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(Path(can_channel).parent))
    for example in EXAMPLES:
        exec(example, {})
    printed = capsys.readouterr().out
    assert re.search(r"ID: +181 .* 01 02 03 ", printed)
    assert "49% to 59%" in printed


def test_every_file_is_named() -> None:
    files = {path.name for path in (ROOT / "hil" / "can").glob("[a-z]*.py")}
    assert files
    assert {name for name in files if f"`{name}`" not in PAGE} == set()
