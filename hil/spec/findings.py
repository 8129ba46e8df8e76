"""Pydantic's errors as findings: at the file's own paths, without what only follows from others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, get_args

from pydantic_core import ErrorDetails

from hil.core import MOST_PROBLEMS, KeyPath, Source, closest, same_quantity
from hil.spec.model_tree import Model, is_model, keys_of, locate, plain


class Finding(NamedTuple):
    """One error of pydantic, told in terms of the file.

    Attributes:
        type: Pydantic's name for this kind of error.
        path: Keys in the file, without union tags.
        about_key: True when the key is wrong and not its value.
        expected: Annotation of what belongs there, None if nothing does.
        holder: Annotation of the mapping or list around it.
        value: What was found; the mapping or list around for something missing.
        ctx: Pydantic's details, such as the limit that was passed.
        told: Pydantic's own message.
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
        """The last step of the path that is a key."""
        return next((step for step in reversed(self.path) if isinstance(step, str)), "")

    @property
    def known_keys(self) -> list[str]:
        """The keys that the mapping around may have."""
        return list(keys_of(self.holder)) if is_model(self.holder) else []

    @property
    def meant(self) -> str | None:
        """The known key that an unknown one most likely stands for."""
        return same_quantity(self.key, self.known_keys) or closest(self.key, self.known_keys)

    @property
    def is_gap(self) -> bool:
        """True for a value missing at the end of a list of fixed length."""
        return self.type == "missing" and bool(self.path) and isinstance(self.path[-1], int)

    @property
    def length(self) -> int:
        """How many values the list of fixed length around a gap has to have."""
        return len(get_args(self.holder))


def findings_of(errors: Iterable[ErrorDetails], model: Model, source: Source) -> list[Finding]:
    """The errors in the order of the file."""
    findings = sorted(
        (_finding(error, model) for error in errors),
        key=lambda f: source.mark(f.path, key=f.about_key),
    )
    unknown = [f for f in findings if f.type == "extra_forbidden"][:MOST_PROBLEMS]
    meant = {(*f.path[:-1], f.meant) for f in unknown}
    # Whatever echoes what: something is wrong, and it must be said.
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
    """True for what a slip reported elsewhere made pydantic say as well."""
    if finding.is_gap:
        return finding.path[-1] != len(finding.value)
    if finding.type == "missing":
        return finding.path in meant
    # A list whose items are wrong counts as empty for pydantic.
    is_list = isinstance(finding.value, list)
    return (
        finding.type == "too_short" and is_list and len(finding.value) >= finding.ctx["min_length"]
    )
