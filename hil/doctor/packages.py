"""Checks of the installed packages: dependencies of hil and its extras, and their versions."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hil.core import plugins
from hil.doctor.finding import Finding

NOT_FOR_USERS = {"all", "dev"}
"""Names of extras that combine other extras, or that only developers of hil need."""

CONSTRAINTS = Path(__file__).resolve().parents[2] / "constraints.txt"
"""Path of the file with the package versions used in tests of hil; the file exists only in a
checkout."""

SHOWN = 3

_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)(?:\[[^]]*])?\s*\(?([^;()]*)\)?\s*(?:;(.*))?")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")
_PYTHON = re.compile(r"""python_version\s*<\s*['"](\d+)\.(\d+)['"]""")


@dataclass(frozen=True, slots=True)
class Need:
    """Package that hil or one of its extras requires.

    Attributes:
        name: Name of the package's distribution.
        bounds: Version bounds of the package, such as `>=2.1,<4`.
        extra: Name of the extra that requires the package; empty if hil itself requires it.
        before: First Python version that does not support the package; None if all versions support
            it.
    """

    name: str
    bounds: str
    extra: str = ""
    before: tuple[int, int] | None = None

    @property
    def problem(self) -> str:
        """Description of a missing or incompatible package; empty if the package is suitable."""
        try:
            version = importlib.metadata.version(self.name)
        except importlib.metadata.PackageNotFoundError:
            return f"{self.name} missing"
        return "" if meets(version, self.bounds) else f"{self.name} {version} is not {self.bounds}"


def needs() -> list[Need]:
    """Return the required packages according to the metadata of the installed hil."""
    out = []
    for line in importlib.metadata.requires("hil") or ():
        if not (match := _REQUIREMENT.fullmatch(line.strip())) or match[1].lower() == "hil":
            continue
        marker = match[3] or ""
        extra, before = _EXTRA.search(marker), _PYTHON.search(marker)
        first = (int(before[1]), int(before[2])) if before else None
        out.append(Need(match[1], match[2].strip(), extra[1] if extra else "", first))
    return out


def meets(version: str, bounds: str) -> bool:
    """Return whether a version is within bounds; only `>=`, `<` and `==` are evaluated.

    Args:
        version: Version of a package, such as `2.13.0+cpu`.
        bounds: Version bounds of the package, such as `>=3.11,<4`.
    """
    have = _numbers(version)
    for bound in filter(None, (part.strip() for part in bounds.split(","))):
        if bound.startswith(">=") and have < _numbers(bound[2:]):
            return False
        if bound.startswith("==") and have != _numbers(bound[2:]):
            return False
        if bound.startswith("<") and not bound.startswith("<=") and have >= _numbers(bound[1:]):
            return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    release = re.match(r"\d+(?:\.\d+)*", version.strip())
    numbers = tuple(map(int, release[0].split("."))) if release else ()
    return numbers + (0,) * (4 - len(numbers))


def core() -> Iterator[Finding]:
    """Yield whether the packages required by hil itself are installed."""
    wanted = [need for need in needs() if not need.extra]
    problems = [need.problem for need in wanted if need.problem]
    if problems:
        yield Finding("packages", f"{'; '.join(problems)}: install hil again", "bad")
    else:
        yield Finding("packages", f"all {len(wanted)} required packages, in suitable versions")


def extras() -> Iterator[Finding]:
    """Yield for each extra whether its packages are installed.

    A missing extra is reported with the level `note`.
    """
    wanted = needs()
    for extra in dict.fromkeys(need.extra for need in wanted if need.extra):
        if extra in NOT_FOR_USERS:
            continue
        own = [need for need in wanted if need.extra == extra]
        late = [n for n in own if n.before is not None and sys.version_info[:2] >= n.before]
        problems = [need.problem for need in own if need not in late and need.problem]
        if late:
            version = ".".join(map(str, late[0].before or ()))
            text = f"{late[0].name} is only for Python before {version}"
            yield Finding(f"extra {extra}", text, "note")
        elif problems:
            text = f'{", ".join(problems)}; to install: pip install "hil[{extra}]"'
            yield Finding(f"extra {extra}", text, "note")
        else:
            yield Finding(f"extra {extra}", "installed")


def constraints(file: Path = CONSTRAINTS) -> Iterator[Finding]:
    """Yield whether the installed versions are the tested ones; nothing outside a checkout.

    Args:
        file: File that contains a line such as `numpy==2.4.6` for each package.
    """
    if not file.is_file():
        return
    lines = (line.partition("==") for line in file.read_text("utf-8").splitlines())
    tested = {name.strip(): version.strip() for name, _, version in lines if version}
    other = []
    for name, version in tested.items():
        have = next((d.version for d in importlib.metadata.distributions(name=name)), None)
        if have is not None and have.partition("+")[0] != version:
            other.append(f"{name} {have} (tested: {version})")
    if other:
        more = f" and {len(other) - SHOWN} more" if len(other) > SHOWN else ""
        text = f"{', '.join(other[:SHOWN])}{more}: pip install -c constraints.txt installs those"
        yield Finding("versions", text, "note")
    else:
        yield Finding("versions", "equal to the tested versions (constraints.txt)")


def torch() -> Iterator[Finding]:
    """Yield the version of torch, and the device for training networks with `device: auto`."""
    try:
        version = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return  # `extras` has reported that the extra `learn` is missing
    if version.endswith("+cpu"):
        yield Finding("torch", f"{version}: networks are trained on the CPU")
        return
    try:
        import torch

        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    except Exception as error:  # for example an incompatible driver or a missing library
        yield Finding("torch", f"{version} cannot be used: {error}", "note")
        return
    yield Finding("torch", f"{version}: networks are trained on {names[0] if names else 'the CPU'}")


def plug_ins() -> Iterator[Finding]:
    """Yield a finding for each plug-in that cannot be loaded."""
    broken = [row for row in plugins.describe_all() if row.error]
    for row in broken:
        yield Finding(f"plug-in {row.name}", row.error, "note")
    if not broken:
        yield Finding("plug-ins", "all can be loaded")
