"""The page about the mock drives' objects has every one of them, as the dictionary has it.

`python -m tests.docs.test_can_objects` prints the tables.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

from hil_mock_robot.cia402.dictionary import COMMUNICATION, DRIVE, TABLE, VENDOR, Group, Object
from tests.support.paths import ROOT

PAGE = ROOT / "docs/reference/mock-can-objects.md"
HEAD = "| object | name | type | access | default | PDO | may be written | unit, remark |"
RULE = "|---|---|---|---|---|---|---|---|"
N_PDOS = 4
WRITTEN_NUMBERS = (0x1003, 0x1600, 0x1A00)
"""Groups whose first member a client may write."""

ALIKE = {0x1003: "Error", 0x1600: "Mapped object", 0x1A00: "Mapped object"}
"""Groups whose members differ in nothing but their numbers."""


def row(entry: Object, where: str, name: str) -> str:
    cells = (
        where, name, entry.type, entry.access, default(entry), "yes" if entry.mappable else "",
        allowed(entry), ", ".join(filter(None, (entry.unit, entry.note))),
    )  # fmt: skip
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def default(entry: Object) -> str:
    if entry.per_axis:
        return "by axis"
    if not isinstance(entry.default, int):
        return str(entry.default)
    text = f"{entry.default:X}h" if entry.default > 0xFFFF else str(entry.default)
    return f"{entry.default:X}h + node" if entry.node_relative else text


def allowed(entry: Object) -> str:
    if not entry.writable:
        return ""
    text = ""
    if entry.choices:
        text = " ".join(map(str, entry.choices)) if len(entry.choices) < 10 else choices(entry)
    elif entry.low is not None or entry.high is not None:
        text = (
            f"{'' if entry.low is None else entry.low} … {'' if entry.high is None else entry.high}"
        )
    return ", ".join(filter(None, (text.strip(), "at rest" if entry.locked else "")))


def choices(entry: Object) -> str:
    return "0–8" if max(entry.choices) < 10 else "0–240 254 255"


def rows(parts: Iterable[Object | Group]) -> list[str]:
    """One line for each variable; of the four PDOs of a kind, only the first."""
    made = []
    for part in parts:
        if 0x1400 <= part.index <= 0x1BFF and part.index % 0x100:
            continue
        if isinstance(part, Object):
            made.append(row(part, f"{part.index:04X}h", part.name))
        else:
            made += members(part)
    return made


def members(part: Group) -> list[str]:
    where = f"{part.index:04X}h:"
    first, *others = part.members
    made = []
    if part.index in WRITTEN_NUMBERS:
        made.append(row(first, f"{where}0", f"{part.name}: {first.name}"))
    if part.index in ALIKE:
        name = f"{part.name}: {ALIKE[part.index]} 1–{len(others)}"
        return [*made, row(others[0], f"{where}1–{len(others):X}", name)]
    return made + [row(e, f"{where}{e.sub:X}", f"{part.name}: {e.name}") for e in others]


def tables() -> dict[str, list[str]]:
    return {
        "Communication (CiA 301)": rows(COMMUNICATION),
        "Manufacturer-specific": rows(VENDOR),
        "Drive (CiA 402)": rows(DRIVE),
    }


def test_the_page_has_the_dictionary_as_it_is():
    told = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| ")]
    told = [line for line in told if line[6:7] == "h"]
    assert told == [line for table in tables().values() for line in table]


def test_the_four_pdos_of_a_direction_have_the_same_objects():
    for base in (0x1400, 0x1600, 0x1800, 0x1A00):
        groups = [part for part in TABLE if base <= part.index < base + N_PDOS]
        subs = {tuple((e.sub, e.type, e.access) for e in part.members) for part in groups}
        assert len(groups) == N_PDOS
        assert len(subs) == 1


if __name__ == "__main__":
    for title, lines in tables().items():
        sys.stdout.write("\n".join((f"## {title}", "", HEAD, RULE, *lines, "", "")))
