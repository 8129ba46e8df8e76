r"""Text that leaves the process: names of files are bytes of any kind, documents are UTF-8.

Python holds a byte of a name that is not UTF-8 as a lone surrogate, so that the file can be opened
by that name. No page, terminal or document takes a lone surrogate: what leaves goes through here.

===============  ==================================  ==========================
leaving as       function                            a byte 0xff of a name
===============  ==================================  ==========================
text, pages      `utf8_text`                         ``\xff``
message          `shown`                             ``?``
JSON             `json_text`                         ``\udcff``, read back as is
name in a form   `name_text`, back by `name_read`    ``\xff``
address          `quoted`                            ``%FF``
command to copy  `shell_word`                        ``$'\xff'``
===============  ==================================  ==========================
"""

from __future__ import annotations

import json
import os
import re
import shlex
from typing import Any
from urllib.parse import quote

_SURROGATE = re.compile("[\ud800-\udfff]")
_ESCAPES = re.compile(r"\\\\|(?:\\x[0-9a-f]{2})+")


def shown(value: object, most: int = 60) -> str:
    """Return a value for a message: on one line, printable, and of at most so many characters."""
    text = value if isinstance(value, str) else repr(value)
    text = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return text if len(text) <= most else text[: most - 1] + "…"


def utf8_text(text: str) -> str:
    r"""Return text that UTF-8 can encode; bytes of a name that are not UTF-8 become ``\xff``."""
    return _SURROGATE.sub(_escaped, text)


def json_text(value: Any, **options: Any) -> str:
    """Return JSON that UTF-8 can hold and that reads back as the same value.

    Args:
        value: What `json.dumps` takes.
        **options: Of `json.dumps`.
    """
    text = json.dumps(value, ensure_ascii=False, **options)
    return text.encode("utf-8", "backslashreplace").decode()


def name_text(name: str | os.PathLike[str]) -> str:
    r"""Return a name on one line, printable: every other byte as ``\xff``, a backslash doubled.

    No two names have the same text, see `name_read`.
    """
    return "".join(
        c if c.isprintable() and c != "\\" else "\\\\" if c == "\\" else _escaped(c)
        for c in os.fspath(name)
    )


def name_read(text: str) -> str:
    """Return the name of a text of `name_text`; a text without escapes is the name itself."""
    return _ESCAPES.sub(_unescaped, text)


def quoted(name: str | os.PathLike[str]) -> str:
    """Return a name as part of an address, with its slashes, byte for byte."""
    return quote(os.fsencode(name))


def shell_word(name: str | os.PathLike[str]) -> str:
    """Return a name as a word for a shell (bash, zsh), printable whatever its bytes are."""
    text = os.fspath(name)
    if text.isprintable():
        return shlex.quote(text)
    return "$'" + name_text(text).replace("'", r"\'") + "'"


def _escaped(match: re.Match[str] | str) -> str:
    c = match if isinstance(match, str) else match[0]
    try:
        return "".join(f"\\x{byte:02x}" for byte in os.fsencode(c))
    except UnicodeEncodeError:  # a surrogate that stands for no byte: out of a document
        return f"\\u{ord(c):04x}"


def _unescaped(match: re.Match[str]) -> str:
    if match[0] == "\\\\":
        return "\\"
    return os.fsdecode(bytes.fromhex(match[0].replace("\\x", "")))
