"""Where a run comes from: code, packages, machine, person. Needs no network and never hangs.

The revision of a repository is read without running anything that the repository can configure. Its
configuration can name programs that git runs by itself: a file system monitor, filters, hooks, a
pager, conversions for diffs, a transport for missing objects, and more of it by includes. They are
the choice of its author, not of the operator who opens a folder of specs. So the commit is read
from plain files, and git compares files under a git directory of our own: of the repository it gets
the objects and the index, and of its configuration only how files are stored (decision 0031).
"""

from __future__ import annotations

import contextlib
import getpass
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

STARTED_ID = "HIL_STARTED_ID"
"""Environment variable that names a process which was started without a console."""

GIT_TIMEOUT_S = 2.0

_PACKAGE = Path(__file__).resolve().parent.parent
_HASH = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?\Z")
_SYMBOLIC_REFS = 5
"""HEAD is one, and may lead to another."""

_SMALL_BYTES = 4096
_PACKED_REFS_BYTES = 64 * 1024**2

_STORAGE = r"^(core\.(filemode|symlinks|ignorecase|autocrlf|eol)|extensions\.objectformat)$"
"""Keys of a git configuration that say how files are stored. None of them names a program."""


def collect_provenance(spec_folder: Path | None = None) -> dict[str, Any]:
    """Return what `start.json` says about the circumstances.

    `git` is the revision of hil itself where it runs from a checkout (its version is among
    `packages`), `spec_git` that of the repository in which the spec is kept.

    Args:
        spec_folder: Folder of the spec.
    """
    return {
        "uid": str(uuid.uuid4()),
        "started": utc_now(),
        "operator": operator(),
        "host": platform.node(),
        "pid": os.getpid(),
        **started_as(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "git": source_revision(),
        "spec_git": git_state(spec_folder) if spec_folder else None,
    }


def started_as() -> dict[str, str]:
    """Return the name under which this process was started; empty if a person started it."""
    name = os.environ.get(STARTED_ID, "")
    return {"started_as": name} if name else {}


def utc_now() -> str:
    """Return the present moment in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def operator() -> str:
    """Return the user of this process."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


def package_versions() -> dict[str, str]:
    """Return the versions of `hil` and of the packages it may use, as far as they are installed."""
    try:
        requirements = importlib.metadata.requires("hil") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = []
    names = {name[0] for line in requirements if (name := re.match(r"[\w.-]+", line))}
    versions = {name: version_of(name) for name in sorted({"hil"} | names)}
    return {name: version for name, version in versions.items() if version}


def version_of(name: str) -> str | None:
    """Return the version of a package, None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def source_revision() -> dict[str, Any] | None:
    """Return the `git_state` of the checkout hil runs from, None if installed from a wheel."""
    # A virtual environment often lies in a repository of another project: it must track hil.
    return git_state(_PACKAGE) if is_tracked(_PACKAGE / "__init__.py") else None


def git_state(directory: Path) -> dict[str, Any] | None:
    """Return commit and whether tracked files differ from it, or None outside a repository.

    `dirty` is None where that is not known without a program of the repository (a changed file with
    a filter), where git is missing, or where it does not answer within two seconds. Submodules are
    not looked into.
    """
    if (repository := _find(directory)) is None or not (sha := _commit(repository)):
        return None
    with contextlib.suppress(OSError, subprocess.SubprocessError), _git(repository, sha) as git:
        return {"sha": sha, "dirty": _dirty(git)}
    return {"sha": sha, "dirty": None}


def is_tracked(path: Path) -> bool:
    """Return whether the repository around a file tracks it; False where git cannot say."""
    if (repository := _find(path.parent)) is None or not (sha := _commit(repository)):
        return False
    name = path.resolve().relative_to(repository.tree).as_posix()
    with contextlib.suppress(OSError, subprocess.SubprocessError), _git(repository, sha) as git:
        return bool(git("ls-files", "-z", "--", f":(literal){name}"))
    return False


def _dirty(git: _Git) -> bool | None:
    options = ("--untracked-files=no", "--ignore-submodules=all", "--no-renames")
    lines = [line for line in git("status", "--porcelain", "-z", *options).split(b"\0") if line]
    if any(not line.startswith(b" M ") for line in lines):
        return True  # staged, deleted, of another type: no content needs to be looked at
    if not lines:
        return False
    changed = b"".join(line[3:] + b"\0" for line in lines)
    filters = git("check-attr", "-z", "--stdin", "filter", stdin=changed).split(b"\0")
    unfiltered = any(value in (b"unspecified", b"unset") for value in filters[2::3])
    return True if unfiltered else None  # what a filter makes of a file is not known here


# Where the repository is, and its commit: read from plain files.


@dataclass(frozen=True, slots=True)
class _Repository:
    """Folders of a repository.

    Attributes:
        tree: Folder of the files.
        own: Git directory of this work tree: HEAD, index.
        common: Git directory that all work trees share: refs, objects, config.
    """

    tree: Path
    own: Path
    common: Path


def _find(directory: Path) -> _Repository | None:
    """Return the repository that contains a folder; None if there is none."""
    here = directory.resolve()
    for tree in (here, *here.parents):
        own = tree / ".git"
        is_link = _is_file(own)
        if link := _text(own):
            own = tree / link.removeprefix("gitdir:").strip()
        if _text(own / "HEAD"):
            shared = _text(own / "commondir")
            return _Repository(tree, own, own / shared if shared else own)
        if is_link:
            return None  # it leads nowhere: the repository around it is another one
    return None


def _commit(repository: _Repository) -> str:
    """Return the hash that HEAD leads to; empty without a commit."""
    text = _text(repository.own / "HEAD")
    for _ in range(_SYMBOLIC_REFS):
        if _HASH.match(text):
            return text
        name = text.removeprefix("ref:").strip()
        text = (
            _text(repository.own / name)
            or _text(repository.common / name)
            or _packed(repository.common / "packed-refs", name)
        )
    return ""


def _packed(path: Path, name: str) -> str:
    lines = _text(path, _PACKED_REFS_BYTES).splitlines()
    return next((line.split(" ")[0] for line in lines if line.endswith(f" {name}")), "")


def _text(path: Path, most: int = _SMALL_BYTES) -> str:
    """Return what a regular file holds; empty of anything else, such as a pipe that never ends.

    It may name a path, whose bytes need not be UTF-8.
    """
    if _is_file(path):
        with contextlib.suppress(OSError), path.open("rb") as file:
            return os.fsdecode(file.read(most)).strip()
    return ""


def _is_file(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):  # ValueError: a NUL in the path
        return path.is_file()
    return False


# Git itself, under a directory of our own.


class _Git:
    """Run git in an environment.

    Args:
        program: Its path.
        tree: Folder it is run in.
        environment: All it gets.
    """

    def __init__(self, program: str, tree: Path, environment: dict[str, str]) -> None:
        self._program, self._tree, self._environment = program, tree, environment

    def __call__(self, *arguments: str, stdin: bytes = b"") -> bytes:
        """Return what git prints.

        Raises:
            SubprocessError: It fails, or does not answer in time.
        """
        return subprocess.run(  # noqa: S603 - fixed arguments, no shell
            [self._program, *arguments],
            cwd=self._tree,
            env=self._environment,
            input=stdin,
            capture_output=True,
            timeout=GIT_TIMEOUT_S,
            check=True,
        ).stdout


@contextlib.contextmanager
def _git(repository: _Repository, sha: str) -> Iterator[_Git]:
    """Make a git directory of our own whose HEAD is a commit of the repository.

    Raises:
        OSError: There is no git, or no place for the directory.
        SubprocessError: The configuration cannot be read.
    """
    # An empty or relative entry is the opened folder: a program there is its author's.
    entries = os.environ.get("PATH", os.defpath).split(os.pathsep)
    places = os.pathsep.join(entry for entry in entries if Path(entry).is_absolute())
    if (program := shutil.which("git", path=places)) is None:
        raise FileNotFoundError("git")
    with tempfile.TemporaryDirectory(prefix="hil-git-") as folder:
        own = Path(folder)
        (own / "refs").mkdir()
        (own / "HEAD").write_text(f"{sha}\n")
        (own / "config").touch()
        environment = {
            # The user's own settings stay out as well: a repository can choose among their filters.
            **{key: value for key, value in os.environ.items() if not key.startswith("GIT_")},
            "PATH": places,
            "HOME": folder,
            "XDG_CONFIG_HOME": folder,
            "GIT_CONFIG_NOSYSTEM": "1",
            "GIT_ATTR_NOSYSTEM": "1",
            "GIT_DIR": folder,
            "GIT_WORK_TREE": str(repository.tree),
            "GIT_INDEX_FILE": str(repository.own / "index"),
            "GIT_OBJECT_DIRECTORY": str(repository.common / "objects"),
            # A look at the repository must not take its index lock from the person using it.
            "GIT_OPTIONAL_LOCKS": "0",
            "GIT_NO_LAZY_FETCH": "1",
            "GIT_TERMINAL_PROMPT": "0",
        }
        # Of its configuration git reads a few keys as text, by a command that includes nothing.
        reading = _Git(program, own, environment)
        config = repository.common / "config"
        if config.is_file():
            (own / "config").write_bytes(_storage(reading, config))
        yield _Git(program, repository.tree, environment)


def _storage(git: _Git, config: Path) -> bytes:
    """Return a configuration with the keys that say how files are stored."""
    options = ("--no-includes", "--null", "--get-regexp", _STORAGE)
    try:
        values = git("config", "--file", str(config), *options).decode("utf-8", "replace")
    except subprocess.CalledProcessError:
        return b""  # none of them is there
    lines = ["[core]", "repositoryformatversion = 1"]
    for key, given, value in (item.partition("\n") for item in values.split("\0") if item):
        section, name = key.split(".")
        if re.fullmatch(r"\w*", value):
            lines += [f"[{section}]", f"{name} = {value}" if given else name]
    return "\n".join([*lines, ""]).encode()
