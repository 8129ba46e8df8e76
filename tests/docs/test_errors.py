"""docs/reference/errors.md has every error with its exit code, as hil/core/errors.py has it."""

from __future__ import annotations

import inspect
import re

from hil.core import errors
from tests.support.paths import DOCS, ROOT

PAGE = (DOCS / "reference" / "errors.md").read_text("utf-8")
COMMANDS = (DOCS / "reference" / "cli.md").read_text("utf-8")
KINDS = [
    kind
    for _, kind in inspect.getmembers(errors, inspect.isclass)
    if issubclass(kind, errors.HilError)
]


def rows() -> dict[str, list[str]]:
    section = PAGE.split("## Each of them")[1]
    return {
        name: [cell.strip() for cell in rest.split("|")]
        for name, rest in re.findall(r"^\| `(\w+)` \| (.*) \|$", section, re.MULTILINE)
    }


def test_every_error_has_a_row_with_its_exit_code() -> None:
    told = {name: cells[0] for name, cells in rows().items()}
    expected = {kind.__name__: str(kind.exit_code) for kind in KINDS}
    assert told == expected | {"Stopped": "6 or 130"}


def test_every_row_says_what_to_do() -> None:
    assert [name for name, cells in rows().items() if len(cells) != 3 or not cells[2]] == []


def test_every_exit_code_is_explained_on_both_pages() -> None:
    codes = {str(kind.exit_code) for kind in KINDS} | {"0", "130"}
    listed = re.findall(r"^\| ([\d, ]+) \|", PAGE.split("## Each of them")[0], re.MULTILINE)
    assert codes == set(re.findall(r"\d+", " ".join(listed)))
    assert codes - {"130"} == set(re.findall(r"^\| (\d+) \|", COMMANDS, re.MULTILINE))


def test_messages_on_the_page_are_written_by_the_code() -> None:
    source = "".join(path.read_text("utf-8") for path in (ROOT / "hil").rglob("*.py"))
    for words in ("there is no estimator", "missed its acceptance criteria", "has no models of"):
        assert words in PAGE
    for words in (
        "missed its acceptance criteria",
        "has no models of",
        "unknown key",
        "the recording contains",
    ):
        assert words in source
