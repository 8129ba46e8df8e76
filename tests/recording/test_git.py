"""The commit of a repository, and that nothing of its author's is run to read it."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

import hil.recording.provenance as reading
from hil.recording.provenance import git_state, is_tracked
from tests.support.git_parts import TRAPS, git, program, repository_with


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A repository that tracks `a.yaml`."""
    made = tmp_path / "specs"
    made.mkdir()
    repository_with(made, "a.yaml")
    return made


@pytest.mark.thorough
@pytest.mark.parametrize("trap", TRAPS.values(), ids=TRAPS)
def test_nothing_that_a_repository_configures_is_run(trap, folder: Path, tmp_path: Path) -> None:
    path, mark = program(tmp_path)
    trap(folder, str(path))
    mark.unlink(missing_ok=True)  # git itself may have run it while the trap was laid
    sha = (folder / ".git" / "refs" / "heads" / "main").read_text().strip()
    state = git_state(folder)
    is_tracked(folder / "a.yaml")
    assert not mark.exists()
    assert state is not None
    assert state["sha"] == sha


@pytest.mark.parametrize("name", ["file system monitor", "filter clean", "include", "submodule"])
def test_git_itself_would_run_these(name: str, folder: Path, tmp_path: Path) -> None:
    path, mark = program(tmp_path)
    TRAPS[name](folder, str(path))
    mark.unlink(missing_ok=True)
    subprocess.run(["git", "status"], cwd=folder, check=False, capture_output=True, timeout=30)
    assert mark.exists()


def test_it_is_the_commit_and_whether_tracked_files_differ(folder: Path) -> None:
    sha = git(folder, "rev-parse", "HEAD")
    (folder / "untracked").write_text("x")
    assert git_state(folder) == {"sha": sha, "dirty": False}
    os.utime(folder / "a.yaml", ns=(0, 0))  # another time of the same content
    assert git_state(folder) == {"sha": sha, "dirty": False}
    (folder / "a.yaml").write_text("2\n")
    assert git_state(folder) == {"sha": sha, "dirty": True}
    git(folder, "add", "a.yaml")
    assert git_state(folder) == {"sha": sha, "dirty": True}


def test_a_folder_below_is_of_the_same_repository(folder: Path) -> None:
    (folder / "below" / "deep").mkdir(parents=True)
    assert git_state(folder / "below" / "deep") == git_state(folder)
    assert git_state(folder) is not None


@pytest.mark.parametrize("change", ["content", "deleted", "staged"])
def test_changes_of_a_filtered_file_are_unknown_only_by_content(change: str, folder: Path) -> None:
    git(folder, "config", "filter.sly.clean", "cat")
    (folder / ".gitattributes").write_text("a.yaml filter=sly\n")
    if change == "deleted":
        (folder / "a.yaml").unlink()
    else:
        (folder / "a.yaml").write_text("2\n")
    if change == "staged":
        git(folder, "add", "a.yaml")
    state = git_state(folder)
    assert state is not None
    assert state["dirty"] is (None if change == "content" else True)


def test_how_files_are_stored_is_as_the_repository_says(folder: Path) -> None:
    git(folder, "config", "core.fileMode", "false")
    (folder / "a.yaml").chmod(0o755)
    assert git_state(folder)["dirty"] is False
    git(folder, "config", "core.autocrlf", "true")
    (folder / "a.yaml").write_bytes(b"1\r\n")
    git(folder, "add", "a.yaml")  # with the same content
    os.utime(folder / "a.yaml", ns=(0, 0))
    assert git_state(folder)["dirty"] is False


def test_references_are_found_wherever_git_keeps_them(folder: Path, tmp_path: Path) -> None:
    sha = git(folder, "rev-parse", "HEAD")
    git(folder, "worktree", "add", "-q", "-b", "other", str(tmp_path / "other"))
    assert git_state(tmp_path / "other") == {"sha": sha, "dirty": False}
    git(folder, "pack-refs", "--all")
    assert git_state(folder) == {"sha": sha, "dirty": False}
    assert git_state(tmp_path / "other") == {"sha": sha, "dirty": False}
    git(folder, "checkout", "-q", "--detach")
    assert git_state(folder) == {"sha": sha, "dirty": False}
    git(folder, "gc", "-q")
    assert git_state(folder) == {"sha": sha, "dirty": False}


def test_a_repository_with_long_hashes(tmp_path: Path) -> None:
    git(tmp_path, "init", "-q", "--object-format=sha256")
    (tmp_path / "a.yaml").write_text("1\n")
    git(tmp_path, "add", "a.yaml")
    git(tmp_path, "commit", "-qm", "one")
    assert git_state(tmp_path) == {"sha": git(tmp_path, "rev-parse", "HEAD"), "dirty": False}


def test_without_a_repository_or_a_commit_there_is_no_state(tmp_path: Path) -> None:
    assert git_state(tmp_path) is None
    git(tmp_path, "init", "-q")
    assert git_state(tmp_path) is None


@pytest.mark.parametrize("where", ["HEAD", "refs/heads/main", "index", "config", "packed-refs"])
def test_a_pipe_in_place_of_a_file_holds_nobody_up(
    where: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "GIT_TIMEOUT_S", 0.2)
    path = folder / ".git" / where
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    git_state(folder)  # opening a pipe without a writer does not return


def test_a_hanging_git_does_not_hold_up_a_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = tmp_path / "git"
    slow.write_text("#!/bin/sh\nexec sleep 400\n")
    slow.chmod(0o755)
    sha = git(folder, "rev-parse", "HEAD")
    monkeypatch.setattr(reading, "GIT_TIMEOUT_S", 0.1)
    monkeypatch.setattr(reading.shutil, "which", lambda name, path: str(slow))
    began = time.monotonic()
    assert git_state(folder) == {"sha": sha, "dirty": None}
    assert time.monotonic() - began < 200.0


def test_without_git_the_commit_is_known_still(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sha = git(folder, "rev-parse", "HEAD")
    monkeypatch.setattr(reading.shutil, "which", lambda name, path: None)
    assert git_state(folder) == {"sha": sha, "dirty": None}
    assert not is_tracked(folder / "a.yaml")


def test_the_environment_names_no_other_repository(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As within a hook of another repository."""
    other = tmp_path / "other"
    other.mkdir()
    repository_with(other, "b.yaml")
    sha = git(folder, "rev-parse", "HEAD")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(other))
    assert git_state(folder) == {"sha": sha, "dirty": False}


def test_only_what_the_index_has_is_tracked(folder: Path) -> None:
    (folder / "[a].yaml").write_text("")
    assert is_tracked(folder / "a.yaml")
    assert not is_tracked(folder / "[a].yaml")


@pytest.mark.parametrize("entry", ["", ".", "bin"])
def test_a_git_in_the_opened_folder_is_not_run(
    entry: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`PATH` with an empty or relative entry, in the folder itself."""
    path, mark = program(tmp_path)
    (folder / "bin").mkdir()
    for place in (folder, folder / "bin"):
        (place / "git").symlink_to(path)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PATH", os.pathsep.join([entry, os.environ["PATH"]]))
    assert git_state(Path()) == {"sha": git_sha(folder), "dirty": False}
    assert not mark.exists()


def test_git_gets_only_the_absolute_entries_of_the_path(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = tmp_path / "shown"
    spy = tmp_path / "bin" / "git"
    spy.parent.mkdir()
    spy.write_text(f'#!/bin/sh\nprintf %s "$PATH" > {shown}\n')
    spy.chmod(0o755)
    monkeypatch.setenv("PATH", os.pathsep.join(["", str(spy.parent), "here", "/usr/bin", "/bin"]))
    git_state(folder)
    assert shown.read_text() == f"{spy.parent}:/usr/bin:/bin"


@pytest.mark.parametrize("link", [b"gitdir: /nowhere", b"gitdir: \xff", b"gitdir:", b""])
def test_a_link_that_leads_nowhere_is_not_of_the_repository_around(
    link: bytes, folder: Path
) -> None:
    (folder / "child" / "below").mkdir(parents=True)
    (folder / "child" / ".git").write_bytes(link + b"\n")
    assert git_state(folder / "child") is None
    assert git_state(folder / "child" / "below") is None


def test_a_link_may_name_a_git_directory_that_is_not_utf_8(folder: Path, tmp_path: Path) -> None:
    sha, target = git_sha(folder), os.fsencode(tmp_path) + b"/odd-\xff"
    os.rename(os.fsencode(folder / ".git"), target)
    (folder / ".git").write_bytes(b"gitdir: " + target + b"\n")
    assert git_state(folder) == {"sha": sha, "dirty": False}


def git_sha(folder: Path) -> str:
    return (folder / ".git" / "refs" / "heads" / "main").read_text().strip()
