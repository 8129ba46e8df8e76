"""First version of a driver in three files: the driver, its test, and the distribution they are in.

The driver is complete for a small protocol of its own, and its test judges it against a simulated
controller: who adapts it to a controller has a driver that keeps the contract at every step.
"""

from __future__ import annotations

import keyword
import re
import sys
from importlib.resources import files

from hil.core import SpecError, plugins

_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def driver_files(name: str) -> dict[str, str]:
    """Return the files of a new driver, name → text.

    Args:
        name: Of the driver, as stations will write it, such as `lab-arm`.

    Raises:
        SpecError: It cannot be the name of a Python module as well, or another module or driver
            has it.
    """
    if not _NAME.fullmatch(name):
        raise SpecError(
            f"--name {name!r}: the name of a driver has small letters, digits and single hyphens",
            hint="such as --name lab-arm",
        )
    module = name.replace("-", "_")
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise SpecError(
            f"--name {name!r}: Python itself uses that name", hint=f"such as --name {name}-arm"
        )
    if name in plugins.names("hil.drivers"):
        raise SpecError(
            f"--name {name!r}: there is a driver of that name already",
            hint=f"such as --name {name}-2; hil plugins lists all drivers",
        )
    class_name = "".join(part.capitalize() for part in name.split("-"))
    made = {
        "pyproject.toml": "driver-pyproject.txt",
        f"{module}.py": "driver.txt",
        f"test_{module}.py": "driver-test.txt",
    }
    folder = files("hil.testing") / "templates"
    texts = {file: (folder / template).read_text("utf-8") for file, template in made.items()}
    for mark, word in (("@name@", name), ("@module@", module), ("@Class@", class_name)):
        texts = {file: text.replace(mark, word) for file, text in texts.items()}
    return texts
