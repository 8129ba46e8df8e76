"""Provenance of a run: revision of the code, package versions, computer and operator.

Collecting the provenance of a run needs no network and cannot block.

The revision of a git repository is read without executing a program that the configuration of the
repository names. The git configuration of a repository can name programs that git executes: a file
system monitor, filters, hooks, a pager, conversions for diffs, a transport for missing objects; the
configuration can also include further configuration files. The author of the repository chooses
these programs, whereas the operator only opens a folder of specs. The commit is therefore read from
plain files, and git compares files with a separate temporary git directory. The temporary git
directory uses the objects and the index of the repository, and only the file storage settings of
the configuration (decision 0031).
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
"""Environment variable with the name under which a process without a console was started."""

GIT_TIMEOUT_S = 2.0

_PACKAGE = Path(__file__).resolve().parent.parent
_HASH = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?\Z")
_SYMBOLIC_REFS = 5
"""Maximum number of git symbolic references that are followed one after the other, starting with
HEAD."""

_SMALL_BYTES = 4096
_PACKED_REFS_BYTES = 64 * 1024**2

_STORAGE = r"^(core\.(filemode|symlinks|ignorecase|autocrlf|eol)|extensions\.objectformat)$"
"""Git configuration keys for file storage; none of these keys names a program."""


def collect_provenance(spec_folder: Path | None = None) -> dict[str, Any]:
    """Return the provenance entries of the start document `start.json`.

    The entry `git` is the revision of hil itself if hil runs from a git checkout; the version of
    hil is in the entry `packages`. The entry `spec_git` is the revision of the git repository that
    contains the spec.

    Args:
        spec_folder: Folder that contains the spec file.
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
    """Return the name under which this process was started without a console.

    The returned mapping is empty if an operator started the process.
    """
    name = os.environ.get(STARTED_ID, "")
    return {"started_as": name} if name else {}


def utc_now() -> str:
    """Return the current UTC time as ISO 8601 text with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def operator() -> str:
    """Return the user name of this process; `unknown` if the process has no user name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


def package_versions() -> dict[str, str]:
    """Return the versions of `hil` and of its installed dependencies."""
    try:
        requirements = importlib.metadata.requires("hil") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = []
    names = {name[0] for line in requirements if (name := re.match(r"[\w.-]+", line))}
    versions = {name: version_of(name) for name in sorted({"hil"} | names)}
    return {name: version for name, version in versions.items() if version}


def version_of(name: str) -> str | None:
    """Return the version of a Python package; None if the package is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def source_revision() -> dict[str, Any] | None:
    """Return the git state of the checkout of hil, or None if hil is installed from a wheel."""
    # A virtual environment is often inside the repository of a different project, so check that the
    # repository tracks hil.
    return git_state(_PACKAGE) if is_tracked(_PACKAGE / "__init__.py") else None


def git_state(directory: Path) -> dict[str, Any] | None:
    """Return the commit of a repository and whether tracked files differ from the commit.

    Outside a repository, the function returns None.

    The entry `dirty` is None if git is missing, if git does not answer within two seconds, or if
    comparing a file would execute a program of the repository (a changed file with a filter).
    Submodules of the repository are not checked.
    """
    if (repository := _find(directory)) is None or not (sha := _commit(repository)):
        return None
    with contextlib.suppress(OSError, subprocess.SubprocessError), _git(repository, sha) as git:
        return {"sha": sha, "dirty": _dirty(git)}
    return {"sha": sha, "dirty": None}


def is_tracked(path: Path) -> bool:
    """Return whether the enclosing repository tracks a file.

    The function returns False if git does not answer.
    """
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
        return True  # staged, deleted or of a different type: the content does not matter
    if not lines:
        return False
    changed = b"".join(line[3:] + b"\0" for line in lines)
    filters = git("check-attr", "-z", "--stdin", "filter", stdin=changed).split(b"\0")
    unfiltered = any(value in (b"unspecified", b"unset") for value in filters[2::3])
    return True if unfiltered else None  # the output of a filter is unknown here


# Location of the repository and its commit, read from plain files.


@dataclass(frozen=True, slots=True)
class _Repository:
    """Paths of the folders of a git repository.

    Attributes:
        tree: Work tree, the folder of the checked-out files.
        own: Git directory of this work tree, which contains HEAD and the index.
        common: Git directory that all work trees share, which contains refs, objects and config.
    """

    tree: Path
    own: Path
    common: Path


def _find(directory: Path) -> _Repository | None:
    """Return the git repository that contains a folder; None if there is no repository."""
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
            return None  # broken link: an enclosing repository would be a different one
    return None


def _commit(repository: _Repository) -> str:
    """Return the commit hash to which HEAD refers; empty text if HEAD has no commit."""
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
    """Return the text of a regular file; empty for other files, such as an endless pipe.

    The content can be a file path, so that its bytes are not always valid UTF-8.
    """
    if _is_file(path):
        with contextlib.suppress(OSError), path.open("rb") as file:
            return os.fsdecode(file.read(most)).strip()
    return ""


def _is_file(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):  # ValueError: the path contains a NUL byte
        return path.is_file()
    return False


# Git commands with a separate git directory.


class _Git:
    """Git command that runs with a fixed environment.

    Args:
        program: Path of the git executable.
        tree: Working directory in which the command runs.
        environment: Complete set of environment variables of the command.
    """

    def __init__(self, program: str, tree: Path, environment: dict[str, str]) -> None:
        self._program, self._tree, self._environment = program, tree, environment

    def __call__(self, *arguments: str, stdin: bytes = b"") -> bytes:
        """Return the text that a git command prints.

        Raises:
            SubprocessError: The command failed or did not answer in time.
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
    """Yield a git command with a temporary git directory whose HEAD is a commit of the repository.

    Raises:
        OSError: Git is not installed, or the temporary directory cannot be created.
        SubprocessError: The configuration of the git repository cannot be read.
    """
    # An empty or relative entry refers to the opened folder, whose programs are not trusted.
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
            # User settings are excluded as well, because a repository can select filters from them.
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
            # Reading the repository must not take the index lock from an operator who works with
            # it.
            "GIT_OPTIONAL_LOCKS": "0",
            "GIT_NO_LAZY_FETCH": "1",
            "GIT_TERMINAL_PROMPT": "0",
        }
        # Git reads only a few keys of the configuration as text, without include directives.
        reading = _Git(program, own, environment)
        config = repository.common / "config"
        if config.is_file():
            (own / "config").write_bytes(_storage(reading, config))
        yield _Git(program, repository.tree, environment)


def _storage(git: _Git, config: Path) -> bytes:
    """Return a git configuration file that contains only the file storage keys."""
    options = ("--no-includes", "--null", "--get-regexp", _STORAGE)
    try:
        values = git("config", "--file", str(config), *options).decode("utf-8", "replace")
    except subprocess.CalledProcessError:
        return b""  # the configuration has no storage key
    lines = ["[core]", "repositoryformatversion = 1"]
    for key, given, value in (item.partition("\n") for item in values.split("\0") if item):
        section, name = key.split(".")
        if re.fullmatch(r"\w*", value):
            lines += [f"[{section}]", f"{name} = {value}" if given else name]
    return "\n".join([*lines, ""]).encode()
