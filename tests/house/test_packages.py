"""What is built and put into a wheel has all that the checkout has."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.support.paths import ROOT


def test_what_pyproject_registers_is_installed() -> None:
    registered = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for group, points in registered["entry-points"].items():
        installed = {point.name: point.value for point in entry_points(group=group)}
        missing = [name for name, value in points.items() if installed.get(name) != value]
        assert not missing, f"{group} in pyproject.toml has {missing}: run pip install -e ."


def test_pre_commit_runs_the_ruff_of_the_constraints() -> None:
    pinned = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text("utf-8").split()
    )
    hooks = (ROOT / ".pre-commit-config.yaml").read_text("utf-8")
    assert f"rev: v{pinned['ruff']}\n" in hooks


# What is built: the source distribution makes the wheel, and that has what the checkout has


BUILD = "import sys, setuptools.build_meta as m; print(getattr(m, sys.argv[1])(sys.argv[2]))"
AT_THE_TOP = ("pyproject.toml", "README.md", "MANIFEST.in")


def built(kind: str, source: Path, folder: Path) -> Path:
    """What setuptools makes of a folder; nothing is fetched and nothing else installed."""
    told = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(folder)],
        cwd=source,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stderr[-3000:]
    return folder / told.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def checkout() -> dict[str, bytes]:
    """Every file of the packages, by its name in a wheel."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for package, root in PACKAGES.items()
        for path in in_git(root / package)
    }


@pytest.fixture(scope="module")
def sdist(checkout: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made from a copy: nothing that an earlier build left gets in."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("sdist")
    for name, content in checkout.items():
        copy = folder / "source" / PACKAGES[name.split("/")[0]].relative_to(ROOT) / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(content)
    (folder / "source" / "tests").mkdir()
    (folder / "source" / "tests" / "test_one.py").touch()
    for name in AT_THE_TOP:
        shutil.copy(ROOT / name, folder / "source")
    return built("build_sdist", folder / "source", folder)


@pytest.mark.thorough
def test_the_wheel_of_the_source_distribution_has_all_that_the_checkout_has(
    sdist: Path, checkout: dict[str, bytes], tmp_path: Path
) -> None:
    with tarfile.open(sdist) as packed:
        packed.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    wheel = zipfile.ZipFile(built("build_wheel", source, tmp_path))
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == set(checkout)
    assert [name for name in sorted(names) if wheel.read(name) != checkout[name]] == []


def test_the_source_distribution_has_no_half_of_the_tests(sdist: Path) -> None:
    """setuptools would take `tests/test*.py`, and nothing of what they need."""
    with tarfile.open(sdist) as packed:
        assert [name for name in packed.getnames() if "/tests/" in name] == []


# What pyproject.toml puts into a wheel is all there is to put: nothing is found here alone


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
