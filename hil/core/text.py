r"""Conversion of text at the borders of the process: file names are bytes, documents are UTF-8.

In Python, a byte of a file name that is not UTF-8 is represented as a lone surrogate, so that
Python can open the file by this name. Pages, terminals and documents do not accept lone surrogates,
so this module converts all output.

===============  =====================================  =============================
output           function                               byte 0xff of a file name
===============  =====================================  =============================
text, pages      `utf8_text`                            ``\xff``
message          `shown`                                ``?``
JSON             `json_text`                            ``\udcff`` (reversible)
name in a form   `name_text`, inverse `name_read`       ``\xff`` (reversible)
URL              `quoted`                               ``%FF``
shell command    `shell_word`                           ``$'\xff'``
===============  =====================================  =============================
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
    """Return a value as text for a message: on one line, printable, at most `most` characters."""
    text = value if isinstance(value, str) else repr(value)
    text = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return text if len(text) <= most else text[: most - 1] + "…"


def utf8_text(text: str) -> str:
    r"""Return text that UTF-8 can encode; bytes of a name that are not UTF-8 become ``\xff``."""
    return _SURROGATE.sub(_escaped, text)


def json_text(value: Any, **options: Any) -> str:
    """Return JSON text that UTF-8 can encode and that is read back as the same value.

    Args:
        value: Value that `json.dumps` accepts.
        **options: Options of `json.dumps`.
    """
    text = json.dumps(value, ensure_ascii=False, **options)
    return text.encode("utf-8", "backslashreplace").decode()


def name_text(name: str | os.PathLike[str]) -> str:
    r"""Return a name on one line with printable characters only.

    Bytes that are not UTF-8, and other unprintable characters, are replaced by ``\xff`` etc.;
    backslashes are doubled. Different names result in different texts, see `name_read`.
    """
    return "".join(
        c if c.isprintable() and c != "\\" else "\\\\" if c == "\\" else _escaped(c)
        for c in os.fspath(name)
    )


def name_read(text: str) -> str:
    """Return the name that belongs to a text of `name_text`; a text without escapes is the name."""
    return _ESCAPES.sub(_unescaped, text)


def quoted(name: str | os.PathLike[str]) -> str:
    """Return a name as part of a URL, byte for byte and with unchanged slashes."""
    return quote(os.fsencode(name))


def shell_word(name: str | os.PathLike[str]) -> str:
    """Return a name as a word for a shell (bash, zsh), printable for any bytes of the name."""
    text = os.fspath(name)
    if text.isprintable():
        return shlex.quote(text)
    return "$'" + name_text(text).replace("'", r"\'") + "'"


def _escaped(match: re.Match[str] | str) -> str:
    c = match if isinstance(match, str) else match[0]
    try:
        return "".join(f"\\x{byte:02x}" for byte in os.fsencode(c))
    except UnicodeEncodeError:  # a surrogate from a document, which represents no byte
        return f"\\u{ord(c):04x}"


def _unescaped(match: re.Match[str]) -> str:
    if match[0] == "\\\\":
        return "\\"
    return os.fsdecode(bytes.fromhex(match[0].replace("\\x", "")))
