"""Templates of plug-ins: a module, its test, and the distribution that registers it.

Every template runs without changes, so that a plug-in is developed by changing working code. The
driver template implements a small protocol, and its test runs the conformance suite against a
simulated controller. The templates of all other kinds of plug-ins are tested on the mock robot.
"""

from __future__ import annotations

import keyword
import re
import sys
from importlib.resources import files

from hil.core import SpecError, plugins

PLUGIN_KINDS = {
    "driver": "robot driver with its conformance test",
    "estimator": "estimator of model parameters with its test",
    "excitation": "excitation that chooses its own poses, with its test",
    "interlock": "interlock that monitors every sample, with its test",
}
"""Kinds of plug-ins that `plugin_files` can create, each with a description."""

_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def plugin_files(kind: str, name: str) -> dict[str, str]:
    """Return the files of a new plug-in as a map from file name to text.

    Args:
        kind: Kind of the plug-in, one of `PLUGIN_KINDS`.
        name: Name of the plug-in in specs and stations, such as `lab-arm`.

    Raises:
        SpecError: The name is not a valid module name, or a different module or plug-in uses the
            name.
    """
    group = f"hil.{kind}s"
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name):
        raise SpecError(
            f"--name {name!r}: the name of a plug-in has small letters, digits and single hyphens",
            hint=f"such as --name my-{kind}",
        )
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise SpecError(
            f"--name {name!r}: Python itself uses that name", hint=f"such as --name {name}-{kind}"
        )
    if name in plugins.names(group):
        raise SpecError(
            f"--name {name!r}: this {kind} exists already",
            hint=f"such as --name {name}-2; `hil plugins` lists all plug-ins",
        )
    templates = {
        "pyproject.toml": "plugin-pyproject.txt",
        f"{module}.py": f"{kind}.txt",
        f"test_{module}.py": f"{kind}-test.txt",
    }
    words = {
        "@name@": name,
        "@module@": module,
        "@group@": group,
        "@Class@": "".join(part.capitalize() for part in name.split("-")),
    }
    folder, made = files("hil.testing") / "templates", {}
    for file, template in templates.items():
        text = (folder / template).read_text("utf-8")
        for mark, word in words.items():
            text = text.replace(mark, word)
        made[file] = text
    return made
