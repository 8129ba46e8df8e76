"""Commands in the documentation: which there are, and which of them a test can run.

A block of shell commands is run when a comment stands right before it, one that readers do not see:

    <!-- run                       `run long`: only among the proofs; `run wire`: over sockets
    hil run experiments/ci_dwell_12.yaml      lines of the shell, run before the block
    runs/… → 1                                what stands for something else in the block
    -->

Blocks of a page share a folder with `experiments/`. `<!-- file: NAME -->` keeps the block after it
there as a file, whatever its language.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.paths import DOCS, EXPERIMENTS, ROOT

PAGES = [
    ROOT / "README.md",
    EXPERIMENTS / "README.md",
    *sorted((DOCS).rglob("*.md")),
]
BLOCK = re.compile(
    r"(?:^<!-- ((?:run|file:)(?:(?!-->).)*?) ?-->\n)?^```(\w*)\n(.*?)^```$", re.M | re.S
)
COMMAND = re.compile(r"\s*(?:[A-Z_]+=\S+ )*(?:\S+/bin/)?(hil|make|python|jupyter) ")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page and the comment before it."""

    page: str
    line: int
    asked: str
    language: str
    text: str

    @property
    def runs(self) -> str:
        """`run`, `run long`, `run wire`, or nothing."""
        head = self.asked.partition("\n")[0].strip()
        return head if head.startswith("run") else ""

    @property
    def commands(self) -> list[str]:
        """Lines that call programs of ours, continued ones joined, without their comments."""
        joined = self.text.replace("\\\n", " ") if self.language == "sh" else ""
        return [line for line in joined.splitlines() if COMMAND.match(line)]

    def script(self) -> str:
        """What is done for this block: its setup, its lines with what stands for something else."""
        if self.asked.startswith("file:"):
            name = self.asked.removeprefix("file:").strip()
            made = f"mkdir -p {shlex.quote(str(Path(name).parent))}\n"
            return f"{made}cat > {shlex.quote(name)} <<'END OF FILE'\n{self.text}END OF FILE\n"
        setup, text = "", self.text
        for line in self.asked.splitlines()[1:]:
            old, arrow, new = line.partition(" → ")
            if arrow and old not in text:
                raise ValueError(f"{self.page}:{self.line}: nothing in the block is {old!r}")
            text = text.replace(old, new) if arrow else text
            setup += "" if arrow else f"{line}\n"
        return f"{setup}{text}"


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in their order."""
    text = page.read_text("utf-8")
    name = page.relative_to(ROOT).as_posix()
    return [
        Block(name, 1 + text.count("\n", 0, found.start(3)), found[1] or "", found[2], found[3])
        for found in BLOCK.finditer(text)
    ]


def run_page(page: str, kinds: tuple[str, ...], folder: Path) -> subprocess.CompletedProcess[str]:
    """Files of a page and its blocks of these kinds, in one shell, to the first failure.

    Nothing that the caller has set for hil gets there, and nothing gets out of the folder.
    """
    shutil.copytree(EXPERIMENTS, folder / "experiments")
    parts = [b.script() for b in blocks(ROOT / page) if b.runs in kinds or b.asked[:5] == "file:"]
    env = {key: value for key, value in os.environ.items() if not key.startswith("HIL_")}
    env["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{env['PATH']}"
    own = {f"HIL_{name.upper()}": str(folder / name) for name in ("leases", "cache")}
    return subprocess.run(
        ["bash", "-euxo", "pipefail", "-c", "".join(parts)],
        cwd=folder,
        env=env | own,
        capture_output=True,
        text=True,
        timeout=1700,
    )


def parse(line: str) -> None:
    """Hold a line against the command line's own parser, running nothing.

    Raises:
        Exception: as the parser does, for a verb, an option or an argument that is not there.
    """
    words = shlex.split(line, comments=True)
    while "=" in words[0]:
        words.pop(0)
    program, *arguments = before_operator(words)
    parsers = {"make": parse_make, "python": parse_python, "jupyter": parse_jupyter}
    parsers.get(Path(program).name, parse_hil)(arguments)


def parse_make(arguments: list[str]) -> None:
    """Targets of the Makefile."""
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))
    if unknown := [word for word in arguments if "=" not in word and word not in targets]:
        raise ValueError(f"the Makefile has no {unknown}")


def parse_python(arguments: list[str]) -> None:
    """Scripts and modules: their own parser, which says how it is called where all is right."""
    done = subprocess.run(
        [sys.executable, *arguments, "--help"], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    if done.returncode:
        raise ValueError(done.stdout + done.stderr)


def parse_jupyter(arguments: list[str]) -> None:
    """Notebooks that are executed; proofs execute them."""
    verb, *notebooks = arguments
    if verb != "execute" or not all((ROOT / name).is_file() for name in notebooks):
        raise ValueError(f"no such notebooks: {arguments}")


def parse_hil(arguments: list[str]) -> None:
    """Verbs, options and arguments of `hil`."""
    import typer

    from hil.cli.app import app

    command: Any = typer.main.get_command(app)
    context = None
    if arguments[:1] and arguments[0] in [name for own in command.params for name in own.opts]:
        return  # `--version`, `--install-completion`: parsing them is doing them
    while hasattr(command, "commands"):
        context = command.make_context(command.name, arguments, parent=context)
        rest = [*context._protected_args, *context.args]
        name, command, arguments = command.resolve_command(context, rest)
    context = command.make_context(name, arguments, parent=context)
    if name == "mock":
        parse_mock(context.params["name"], context.args)


def parse_mock(name: str, arguments: list[str]) -> None:
    """What a mock's own command line takes; requests to one that runs have tests of their own."""
    from hil_mock_robot.cia402.mock import parser_of as can
    from hil_mock_robot.twincat.mock import parser_of as plc
    from hil_mock_robot.ur.mock import parser_of as ur

    parsers = {"can": can, "plc": plc, "ur": ur}
    if name in parsers and arguments[:1] != ["send"]:
        parsers[name]().parse_args(arguments)
    elif name not in ("list", "embedded", *parsers) or (name not in parsers and arguments):
        raise ValueError(f"no mock {name!r} with {arguments}")


def before_operator(words: list[str]) -> Iterator[str]:
    """Words of the first command of a line."""
    for word in words:
        if word in ("&", "|", "||", "&&", ">", ">>", ";"):
            return
        yield word
