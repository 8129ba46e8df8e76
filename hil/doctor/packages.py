"""Checks of the installed packages: what hil and its extras need, and whether versions fit."""

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
"""Extras that gather others, and those of a developer of hil."""

CONSTRAINTS = Path(__file__).resolve().parents[2] / "constraints.txt"
"""Only in a checkout: the versions that hil was tested with."""

SHOWN = 3

_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)(?:\[[^]]*])?\s*\(?([^;()]*)\)?\s*(?:;(.*))?")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")
_PYTHON = re.compile(r"""python_version\s*<\s*['"](\d+)\.(\d+)['"]""")


@dataclass(frozen=True, slots=True)
class Need:
    """One package that hil or an extra of it needs.

    Attributes:
        name: Name of the distribution.
        bounds: Such as `>=2.1,<4`.
        extra: The extra that needs it; empty for hil itself.
        before: The first version of Python that it is not for, if any.
    """

    name: str
    bounds: str
    extra: str = ""
    before: tuple[int, int] | None = None

    @property
    def problem(self) -> str:
        """Why it does not fit; empty if it does."""
        try:
            version = importlib.metadata.version(self.name)
        except importlib.metadata.PackageNotFoundError:
            return f"{self.name} missing"
        return "" if meets(version, self.bounds) else f"{self.name} {version} is not {self.bounds}"


def needs() -> list[Need]:
    """Return what the metadata of the installed hil says that it needs."""
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
    """Return whether a version is within bounds; only `>=`, `<` and `==` count.

    Args:
        version: Such as `2.13.0+cpu`.
        bounds: Such as `>=3.11,<4`.
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
    """Yield whether the packages are there that hil itself needs."""
    wanted = [need for need in needs() if not need.extra]
    problems = [need.problem for need in wanted if need.problem]
    if problems:
        yield Finding("packages", f"{'; '.join(problems)}: install hil again", "bad")
    else:
        yield Finding("packages", f"all {len(wanted)} that hil needs, new enough")


def extras() -> Iterator[Finding]:
    """Yield for each extra whether its packages are there; a missing one is a note."""
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
            text = f'{", ".join(problems)}; for it: pip install "hil[{extra}]"'
            yield Finding(f"extra {extra}", text, "note")
        else:
            yield Finding(f"extra {extra}", "installed")


def constraints(file: Path = CONSTRAINTS) -> Iterator[Finding]:
    """Yield whether versions are those that hil was tested with; nothing outside a checkout.

    Args:
        file: With a line such as `numpy==2.4.6` per package.
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
        text = f"{', '.join(other[:SHOWN])}{more}: pip install -c constraints.txt has those"
        yield Finding("versions", text, "note")
    else:
        yield Finding("versions", "those that hil was tested with (constraints.txt)")


def torch() -> Iterator[Finding]:
    """Yield the version of torch, and what networks are trained on by `device: auto`."""
    try:
        version = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return  # `extras` has said that the extra `learn` is missing
    if version.endswith("+cpu"):
        yield Finding("torch", f"{version}: networks are trained on the CPU")
        return
    try:
        import torch

        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    except Exception as error:  # a driver that does not fit, a library that is missing, …
        yield Finding("torch", f"{version} cannot be used: {error}", "note")
        return
    yield Finding("torch", f"{version}: networks are trained on {names[0] if names else 'the CPU'}")


def plug_ins() -> Iterator[Finding]:
    """Yield the plug-ins that are broken."""
    broken = [row for row in plugins.describe_all() if row.error]
    for row in broken:
        yield Finding(f"plug-in {row.name}", row.error, "note")
    if not broken:
        yield Finding("plug-ins", "all load")
