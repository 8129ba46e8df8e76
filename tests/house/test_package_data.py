"""What pyproject.toml puts into a wheel is all there is to put: nothing is found here alone."""

from __future__ import annotations

import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT

SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
PACKAGES = {"hil": ROOT, "hil_drivers": ROOT / "drivers", "hil_mock_robot": ROOT / "mock_robot"}


def in_git(folder: Path) -> list[Path]:
    """Files that are kept, or are new and not ignored."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if listed.returncode:
        pytest.skip("no git checkout")
    paths = {ROOT / name for name in listed.stdout.split("\0") if name}
    return sorted(path for path in paths if path.is_file())


def packed(package: str, folder: Path) -> set[Path]:
    """Files beside code that a wheel gets, as setuptools understands its patterns."""
    patterns = SETUPTOOLS["package-data"].get(package, [])
    return {path for pattern in patterns for path in folder.glob(pattern)}


@pytest.mark.parametrize("package", PACKAGES)
def test_files_beside_the_code_are_packed(package: str) -> None:
    folder = PACKAGES[package] / package
    beside = {path for path in in_git(folder) if path.suffix != ".py"}
    assert beside - packed(package, folder) == set(), "add them to package-data in pyproject.toml"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_pattern_finds_something(package: str) -> None:
    folder = PACKAGES[package] / package
    patterns = SETUPTOOLS["package-data"][package]
    assert [pattern for pattern in patterns if not list(folder.glob(pattern))] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_every_folder_of_code_is_a_package(package: str) -> None:
    """`packages.find` leaves out folders without an `__init__.py`, and says nothing."""
    folder = PACKAGES[package] / package
    folders = {path.parent for path in in_git(folder) if path.suffix == ".py"}
    assert [each for each in sorted(folders) if not (each / "__init__.py").exists()] == []


def test_all_packages_are_looked_for() -> None:
    where = SETUPTOOLS["packages"]["find"]
    assert {ROOT / place for place in where["where"]} == set(PACKAGES.values())
    assert where["include"] == [f"{package}*" for package in PACKAGES]
