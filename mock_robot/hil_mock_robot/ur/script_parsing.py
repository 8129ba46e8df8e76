"""Parser of URScript into statements; Python's parser reads expressions, without `eval`."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from keyword import iskeyword

from hil_mock_robot.ur.script_errors import ScriptError

LONGEST_LINE, DEEPEST, DEEPEST_EXPRESSION = 4000, 30, 60
_OPENING = re.compile(r"(def|sec|thread|if|while)\b.*:$")
_DEF = re.compile(r"(def|sec)\s+([A-Za-z_]\w*)\s*\(([^()]*)\)\s*:$")
_ASSIGNMENT = re.compile(r"(?:global\s+|local\s+)?([A-Za-z_]\w*(?:\s*\[[^\]=]*\])?)\s*=(?!=)(.*)$")


@dataclass(frozen=True, slots=True)
class Statement:
    """Statement of a program.

    Attributes:
        line: Line number in the text, from 1.
        kind: `call`, `assign`, `if`, `while`, `def`, `return`, `break`, `continue`, `halt`.
        value: Called, assigned or returned expression, or the condition.
        target: Assigned variable, or name of the defined function.
        parameters: Parameters of the defined function.
        body, orelse: Inner blocks.
    """

    line: int
    kind: str
    value: ast.expr | None = None
    target: ast.expr | str | None = None
    parameters: tuple[str, ...] = ()
    body: tuple[Statement, ...] = ()
    orelse: tuple[Statement, ...] = ()


@dataclass(slots=True)
class _Lines:
    """Non-empty lines of a text, read one after the other."""

    numbered: list[tuple[int, str]]
    at: int = 0

    @property
    def left(self) -> bool:
        return self.at < len(self.numbered)

    def peek(self) -> str:
        return self.numbered[self.at][1] if self.left else ""

    def take(self) -> tuple[int, str]:
        self.at += 1
        return self.numbered[self.at - 1]


def opens_block(line: str) -> bool:
    """Return whether a line without comment and whitespace opens a block that needs an `end`."""
    return _OPENING.match(line) is not None


def stripped(line: str) -> str:
    """Return the line without surrounding whitespace and without its comment."""
    if "#" not in line:
        return line.strip()
    kept, quoted = [], False
    for letter in line:
        quoted ^= letter == '"'
        if letter == "#" and not quoted:
            break
        kept.append(letter)
    return "".join(kept).strip()


def parse(text: str) -> tuple[Statement, ...]:
    """Return all statements of a text.

    Raises:
        ScriptError: The text is not URScript that the mock supports; the message names the line.
    """
    numbered = ((i, stripped(line)) for i, line in enumerate(text.splitlines(), 1))
    lines = _Lines([(i, line) for i, line in numbered if line])
    block = tuple(_block(lines, 0))
    if lines.left:
        number, line = lines.take()
        raise ScriptError(number, f"syntax error at {line[:40]!r}", syntax=True)
    return block


def _block(lines: _Lines, depth: int) -> Iterator[Statement]:
    if depth > DEEPEST:
        raise ScriptError(lines.take()[0] if lines.left else 0, "blocks are nested too deeply")
    while lines.left and not re.match(r"(end|else\s*:|elif\b.*:)$", lines.peek()):
        yield _statement(*lines.take(), lines, depth)


def _statement(number: int, line: str, lines: _Lines, depth: int) -> Statement:
    if defined := _DEF.match(line):
        names = tuple(name.strip() for name in defined[3].split(",") if name.strip())
        body = _closed(lines, depth, number)
        return Statement(number, "def", None, defined[2], names, body)
    if condition := re.match(r"(if|while)\b(.*):$", line):
        return _conditional(number, condition[1], condition[2], lines, depth)
    if line in ("break", "continue", "halt", "return"):
        return Statement(number, line)
    if returned := re.match(r"return\b(.*)$", line):
        return Statement(number, "return", expression(number, returned[1]))
    if assigned := _ASSIGNMENT.match(line):
        target = expression(number, assigned[1])
        return Statement(number, "assign", expression(number, assigned[2]), target)
    return Statement(number, "call", expression(number, line))


def _conditional(number: int, kind: str, test: str, lines: _Lines, depth: int) -> Statement:
    value = expression(number, test)
    body = tuple(_block(lines, depth + 1))
    orelse: tuple[Statement, ...] = ()
    if kind == "if" and (other := re.match(r"elif\b(.*):$", lines.peek())):
        at, _ = lines.take()
        return Statement(
            number, "if", value, body=body,
            orelse=(_conditional(at, "if", other[1], lines, depth + 1),),
        )  # fmt: skip
    if kind == "if" and re.match(r"else\s*:$", lines.peek()):
        lines.take()
        orelse = tuple(_block(lines, depth + 1))
    _require_end(lines, number)
    return Statement(number, kind, value, body=body, orelse=orelse)


def _closed(lines: _Lines, depth: int, number: int) -> tuple[Statement, ...]:
    body = tuple(_block(lines, depth + 1))
    _require_end(lines, number)
    return body


def _require_end(lines: _Lines, number: int) -> None:
    if lines.peek() != "end":
        raise ScriptError(number, "the block has no end")
    lines.take()


def expression(number: int, text: str) -> ast.expr:
    """Return the parsed expression of line `number`.

    Raises:
        ScriptError: The text is not a valid expression.
    """
    if len(text) > LONGEST_LINE:
        raise ScriptError(number, "the line is too long")
    text = text.strip()
    if text.isidentifier() and not iskeyword(text):
        return ast.Name(text, ast.Load())
    try:
        parsed = ast.parse(_with_xor(text), mode="eval").body
        # A shorter text cannot be nested deeper, and most lines are shorter.
        if len(text) > DEEPEST_EXPRESSION // 2 and _depth(parsed) > DEEPEST_EXPRESSION:
            raise ScriptError(number, "the expression is nested too deeply")
        return parsed
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ScriptError(number, f"syntax error at {text[:40]!r}", syntax=True) from error


def _with_xor(text: str) -> str:
    """Return the text with `xor` replaced by Python's operator."""
    if "xor" not in text:
        return text
    return "".join(
        part if part.startswith('"') else re.sub(r"\bxor\b", "^", part)
        for part in re.split(r'("[^"]*")', text)
    )


def _depth(root: ast.expr) -> int:
    level: list[ast.AST] = [root]
    depth = 0
    while level:
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        depth += 1
    return depth
