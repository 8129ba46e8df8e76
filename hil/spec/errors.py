"""Error messages for YAML files: one plain sentence per kind of error.

Errors of pydantic are first converted to findings, with the paths of the file, and without errors
that are only consequences of other errors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, get_args

from pydantic_core import ErrorDetails

from hil.core import (
    MOST_PROBLEMS,
    KeyPath,
    Problem,
    Source,
    closest,
    converted,
    did_you_mean,
    dotted,
    is_number,
    parse_quantity,
    same_quantity,
    shown,
    split_unit,
    symbol_of,
)
from hil.spec.model_tree import Model, choices_of, is_model, keys_of, kinds_of, locate, plain, tree


class Finding(NamedTuple):
    """Error of pydantic, expressed with the keys of the file.

    Attributes:
        type: Name of the error type in pydantic.
        path: Keys that lead to the invalid value in the file, without union tags.
        about_key: Whether the key is wrong instead of the value of the key.
        expected: Annotation of the expected value; None if no value is expected.
        holder: Annotation of the surrounding mapping or list.
        value: Invalid value; for a missing key, the surrounding mapping or list.
        ctx: Details of the error from pydantic, such as the violated limit.
        told: Error message from pydantic.
    """

    type: str
    path: KeyPath
    about_key: bool
    expected: Any
    holder: Any
    value: Any
    ctx: Mapping[str, Any]
    told: str

    @property
    def key(self) -> str:
        """Last key in the path of the finding; list indices are skipped."""
        return next((step for step in reversed(self.path) if isinstance(step, str)), "")

    @property
    def known_keys(self) -> list[str]:
        """Keys that are allowed in the surrounding mapping."""
        return list(keys_of(self.holder)) if is_model(self.holder) else []

    @property
    def meant(self) -> str | None:
        """Known key that the user most likely meant by the unknown key."""
        return same_quantity(self.key, self.known_keys) or closest(self.key, self.known_keys)

    @property
    def is_gap(self) -> bool:
        """Whether a value is missing at the end of a list of fixed length."""
        return self.type == "missing" and bool(self.path) and isinstance(self.path[-1], int)

    @property
    def length(self) -> int:
        """Required length of the surrounding list of fixed length."""
        return len(get_args(self.holder))


def explain(finding: Finding, model: Model, source: Source) -> Problem:
    """Return the problem for a finding, with its position in the file."""
    path = finding.path[:-1] if finding.is_gap else finding.path
    if finding.type == "extra_forbidden":
        message = _unknown_key(finding, model)
    elif finding.value is None and finding.type != "missing":
        message = f"has no value: {_what_to_give(source, path)}"
    else:
        sentence = _SENTENCES.get(finding.type)
        message = sentence(finding) if sentence else finding.told
    return Problem(source.mark(path, key=finding.about_key), path, message)


def _unknown_key(f: Finding, model: Model) -> str:
    if known := same_quantity(f.key, f.known_keys):
        return f"unknown key; {_other_unit(f.key, known, f.value)}"
    if known := closest(f.key, f.known_keys):
        return f"unknown key; did you mean {known!r}?"
    if elsewhere := _home_of(f, model):
        return f"unknown key; {elsewhere}"
    return f"unknown key; known here: {', '.join(f.known_keys)}"


def _other_unit(key: str, known: str, value: Any) -> str:
    new_value = converted(value, split_unit(key.casefold())[1], split_unit(known)[1])
    use = f"{known}: {new_value}" if new_value is not None else known
    return f"quantities carry their unit in the key: use {use}"


def _home_of(f: Finding, model: Model) -> str:
    """Return where a key that is unknown at this position would be valid; empty if nowhere."""
    for path, owner in tree(model):
        if f.key not in keys_of(owner) or not path:
            continue
        kinds = choices_of(keys_of(owner)["kind"].annotation) if "kind" in keys_of(owner) else ()
        with_kind = f" with `kind: {kinds[0]}`" if kinds else ""
        return f"it belongs to `{dotted(path)}`{with_kind}"
    return ""


def _what_to_give(source: Source, path: KeyPath) -> str:
    """Return the advice for a key without a value; an override cannot remove a key."""
    if source.mark(path).line:
        return "add a value, or remove the key"
    return "write a value after the = (an empty list is [], an empty text '')"


def findings_of(errors: Iterable[ErrorDetails], model: Model, source: Source) -> list[Finding]:
    """Return the findings for the errors of pydantic, in the order of the file."""
    findings = sorted(
        (_finding(error, model) for error in errors),
        key=lambda f: source.mark(f.path, key=f.about_key),
    )
    unknown = [f for f in findings if f.type == "extra_forbidden"][:MOST_PROBLEMS]
    meant = {(*f.path[:-1], f.meant) for f in unknown}
    # If every finding is an echo, report all of them, because at least one is an error.
    return [f for f in findings if not _is_echo(f, meant)] or findings


def _finding(error: ErrorDetails, model: Model) -> Finding:
    loc, kind, ctx = error["loc"], error["type"], error.get("ctx", {})
    path, expected = locate(model, loc)
    holder = plain(locate(model, loc[:-1])[1])
    if kind == "mistake":
        path = (*path, *ctx["at"])
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        path = (*path, "kind")
    about_key = kind == "extra_forbidden" or loc[-1:] == ("[key]",)
    return Finding(kind, path, about_key, expected, holder, error["input"], ctx, error["msg"])


def _is_echo(finding: Finding, meant: set[tuple[str | int | None, ...]]) -> bool:
    """Return whether a finding is only the consequence of an error that is reported elsewhere."""
    if finding.is_gap:
        return finding.path[-1] != len(finding.value)
    if finding.type == "missing":
        return finding.path in meant
    # Pydantic counts a list with invalid items as empty.
    is_list = isinstance(finding.value, list)
    return (
        finding.type == "too_short" and is_list and len(finding.value) >= finding.ctx["min_length"]
    )


def _missing(f: Finding) -> str:
    if f.is_gap:
        return f"needs {f.length} values, but has {len(f.value)}"
    field = keys_of(f.holder)[f.key] if is_model(f.holder) else None
    meaning = f": {field.description}" if field and field.description else ""
    others = [key for key in f.value if key not in f.known_keys]
    if slip := closest(f.key, others):
        return f"is missing; is {slip!r} a misspelling of it?"
    return f"is missing{meaning.rstrip('.')}"


def _number(f: Finding) -> str:
    if not isinstance(f.value, str):
        return f"must be a number, not {name_of(f.value)}"
    quantity, in_key = parse_quantity(f.value), split_unit(f.key)[1]
    if quantity and (value := converted(*quantity, in_key)) is not None:
        return f"the key contains the unit, so write only the number: {f.key}: {value}"
    return f"must be a number, not the text {name_of(f.value)}{_slip_in_number(f.value)}"


def _slip_in_number(text: str) -> str:
    if is_number(text):
        return ": remove the quotes"
    if re.fullmatch(r"[-+]?\d+,\d+", text):
        return ": write a decimal point"
    return ": write it without '_'" if re.fullmatch(r"[-+]?\d+(_\d+)+", text) else ""


def name_of(value: Any) -> str:
    """Return a readable description of a value."""
    if isinstance(value, bool):
        return "true" if value else "false"
    names = {type(None): "nothing", list: "a list", dict: "a mapping", str: f"'{shown(value)}'"}
    return names.get(type(value)) or shown(value)


def _limit(words: str, name: str) -> Callable[[Finding], str]:
    def sentence(f: Finding) -> str:
        unit = symbol_of(f.key)
        return f"must be {words} {f.ctx[name]:g}{' ' + unit if unit else ''}, not {f.value:g}"

    return sentence


def _literal(f: Finding) -> str:
    choices = [str(choice) for choice in choices_of(f.expected)]
    if not choices:  # in a mapping with keys of a plug-in
        return f.told
    if f.key in ("hil", "hil_station", "hil_series", "hil_schedule", "hil_fleet"):
        return f"this version of hil reads format {choices[0]}, not {name_of(f.value)}"
    if len(choices) == 1:
        return f"must be {choices[0]}, not {name_of(f.value)}"
    match = closest(f.value, choices) if isinstance(f.value, str) else None
    hint = f"; did you mean {match!r}?" if match else ""
    return f"must be one of {', '.join(choices)}, not {name_of(f.value)}{hint}"


def _kind(f: Finding) -> str:
    kinds = list(kinds_of(f.expected))
    if f.type == "union_tag_not_found":
        return f"is missing: one of {', '.join(kinds)}"
    tag = shown(f.ctx["tag"])
    return f"there is no kind '{tag}'; {did_you_mean(tag, kinds)}"


def _text(f: Finding) -> str:
    if isinstance(f.value, list | dict):
        return f"must be text, not {name_of(f.value)}"
    return f"must be text: put it in quotes, '{name_of(f.value)}'"


def _too_long(f: Finding) -> str:
    return f"needs {f.ctx['max_length']} values, but has {f.ctx['actual_length']}"


def _too_short(f: Finding) -> str:
    return f"must not be empty: at least {f.ctx['min_length']} required"


def _mapping(f: Finding) -> str:
    inner = plain(f.expected)
    keys = list(keys_of(inner)) if is_model(inner) else ["kind"] if kinds_of(inner) else []
    known = f" with keys such as {', '.join(keys[:3])}" if keys else ""
    return f"must be a mapping{known}, not {name_of(f.value)}"


_SENTENCES: dict[str, Callable[[Finding], str]] = {
    "missing": _missing,
    "mistake": lambda f: str(f.ctx["message"]),
    "not_a_number": _number,
    "float_type": _number,
    "int_type": _number,
    "int_from_float": lambda f: f"must be a whole number, not {name_of(f.value)}",
    "finite_number": lambda f: f"must be a finite number, not {name_of(f.value)}",
    "greater_than": _limit("above", "gt"),
    "greater_than_equal": _limit("at least", "ge"),
    "less_than": _limit("below", "lt"),
    "less_than_equal": _limit("at most", "le"),
    "literal_error": _literal,
    "union_tag_invalid": _kind,
    "union_tag_not_found": _kind,
    "string_type": _text,
    "bool_type": lambda f: f"must be true or false, not {name_of(f.value)}",
    "string_pattern_mismatch": lambda f: (
        "must begin with a letter or digit and contain only letters, digits, '_', '.' and '-', at "
        f"most 64 characters, not {name_of(f.value)}"
    ),
    "tuple_type": lambda f: f"must be a list, not {name_of(f.value)}",
    "too_long": _too_long,
    "too_short": _too_short,
    "dict_type": _mapping,
    "model_type": _mapping,
    "model_attributes_type": _mapping,
}
