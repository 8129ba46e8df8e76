"""Repositories for tests, also such as run a program of their author's when git looks at them."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

Trap = Callable[[Path, str], None]
"""Makes a repository run a command; gets its folder and the path of the program."""


def git(directory: Path, *arguments: str) -> str:
    """Run git with an identity of its own and return what it prints."""
    identity = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", *identity, *arguments], cwd=directory, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def repository_with(directory: Path, *files: str) -> str:
    """Make `directory` a repository that tracks files; return its commit."""
    git(directory, "init", "-q", "-b", "main")
    for file in files:
        (directory / file).write_text("1\n")
        git(directory, "add", "-f", file)
    git(directory, "commit", "-qm", "one")
    return git(directory, "rev-parse", "HEAD")


def program(folder: Path) -> tuple[Path, Path]:
    """Write a program that leaves a mark; return both paths."""
    path, mark = folder / "program", folder / "mark"
    path.write_text(f'#!/bin/sh\ntouch "{mark}"\ncat\n')
    path.chmod(0o755)
    return path, mark


def _set(key: str, value: str = "{}") -> Trap:
    return lambda folder, path: void(git(folder, "config", key, value.format(path)))


def _filter(key: str) -> Trap:
    """Filter a tracked file that has changed, of the same length."""

    def trap(folder: Path, path: str) -> None:
        git(folder, "config", f"filter.sly.{key}", path)
        (folder / ".gitattributes").write_text("* filter=sly diff=sly\n")
        (folder / "a.yaml").write_text("2\n")

    return trap


def _diff(key: str) -> Trap:
    def trap(folder: Path, path: str) -> None:
        git(folder, "config", key, path)
        (folder / ".gitattributes").write_text("* diff=sly\n")
        (folder / "a.yaml").write_text("2\n")

    return trap


def _hooks(folder: Path, path: str) -> None:
    names = ("post-index-change", "reference-transaction", "pre-commit", "post-checkout",
             "fsmonitor-watchman", "pre-auto-gc", "query-watchman")  # fmt: skip
    for name in names:
        hook = folder / ".git" / "hooks" / name
        hook.unlink(missing_ok=True)
        hook.symlink_to(path)
    (folder / "a.yaml").touch()


def _included(folder: Path, path: str) -> None:
    (folder / "more").write_text(f'[core]\n\tfsmonitor = "{path}"\n')
    git(folder, "config", "include.path", str(folder / "more"))


def _included_by_place(folder: Path, path: str) -> None:
    (folder / "more").write_text(f'[core]\n\tfsmonitor = "{path}"\n')
    git(folder, "config", f"includeIf.gitdir:{folder}/.path", str(folder / "more"))


def _submodule(folder: Path, path: str) -> None:
    inner = folder / "inner"
    inner.mkdir()
    repository_with(inner, "b.yaml")
    git(folder, "add", "inner")
    git(folder, "commit", "-qm", "two")
    git(inner, "config", "core.fsmonitor", path)


def _missing_objects(folder: Path, path: str) -> None:
    """Lack the files of the commit, and name a transport that could bring them."""
    for key, value in {
        "extensions.partialClone": "away",
        "remote.away.promisor": "true",
        "remote.away.url": "ssh://example.org/away",
        "core.sshCommand": path,
        "credential.helper": f"!{path}",
    }.items():
        git(folder, "config", key, value)
    tree = git(folder, "rev-parse", "HEAD^{tree}")
    (folder / ".git" / "objects" / tree[:2] / tree[2:]).unlink()


def void(_: object) -> None:
    """Drop a value."""


TRAPS: dict[str, Trap] = {
    "file system monitor": _set("core.fsmonitor"),
    "file system monitor of a shell": _set("core.fsmonitor", "{} #"),
    "filter clean": _filter("clean"),
    "filter smudge": _filter("smudge"),
    "filter process": _filter("process"),
    "hooks": _hooks,
    "hooks elsewhere": lambda folder, path: (
        _hooks(folder, path),
        (folder / ".git" / "hooks").rename(folder / "hooks"),
        git(folder, "config", "core.hooksPath", str(folder / "hooks")),
    )[0],
    "pager": _set("core.pager"),
    "pager of status": _set("pager.status"),
    "external diff": _diff("diff.external"),
    "diff command": _diff("diff.sly.command"),
    "text conversion": _diff("diff.sly.textconv"),
    "alias": _set("alias.status", "!{}"),
    "include": _included,
    "include by place": _included_by_place,
    "submodule": _submodule,
    "transport of missing objects": _missing_objects,
    "editor": _set("core.editor"),
    "signature program": _set("gpg.program"),
    "alternate refs": _set("core.alternateRefsCommand"),
}
"""What a repository can have git run, by name."""
