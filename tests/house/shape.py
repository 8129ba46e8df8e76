"""Print the shape of the code: packages in order, files, lines, importers and import circles.

`make shape` prints it for this checkout, `python tests/house/shape.py ROOT` for another one. It is
information without limits: what must not be imported stands in the import contracts (`make walls`).
"""

from __future__ import annotations

import argparse
import ast
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from textwrap import fill

FOLDERS = {"hil": ".", "hil_drivers": "drivers", "hil_mock_robot": "mock_robot"}
"""Where the packages lie that can be imported."""

ROOT_MODULES = "(root)"
ALWAYS, FUNCTION, FACE, TYPING = "always", "function", "face", "typing"
WIDTH = 100

Graph = dict[str, set[str]]

LEGEND = """\
files     a face (__init__) and the stub that lists its names are one
median    lines of the package's median file
none …    modules of the package that no, one, or more modules import
reached   modules behind the face that modules of other packages import
functions imports inside functions: of our own modules / of other libraries
typing    imports of our own modules under `if TYPE_CHECKING`"""


@dataclass(frozen=True)
class Import:
    """One imported name, as `module` or `module.name`, and when it is imported.

    A face that loads nothing imports at first use (FACE) what its stub, `__init__.pyi`, lists.
    """

    name: str
    when: str

    @property
    def is_own(self) -> bool:
        return self.name.split(".")[0] in FOLDERS


@dataclass(frozen=True)
class Module:
    """One file, the package that it counts for, its lines and its imports."""

    name: str
    package: str
    is_face: bool
    lines: int
    imports: tuple[Import, ...]


def read_modules(root: Path) -> dict[str, Module]:
    """Return all modules of a checkout by name."""
    modules = {}
    for top, folder in FOLDERS.items():
        for path in sorted((root / folder / top).rglob("*.py")):
            parts = path.relative_to(root / folder).with_suffix("").parts
            is_face = parts[-1] == "__init__"
            name = ".".join(parts[:-1] if is_face else parts)
            package = ".".join(parts[:2]) if len(parts) > 2 else f"{top}.{ROOT_MODULES}"
            text = path.read_text("utf-8")
            imports = [*imports_in(ast.parse(text), ".".join(parts[:-1]))]
            if (stub := path.with_suffix(".pyi")).is_file():
                listed = stub.read_text("utf-8")
                imports += imports_in(ast.parse(listed), ".".join(parts[:-1]), FACE)
                text += listed
            modules[name] = Module(name, package, is_face, text.count("\n"), tuple(imports))
    return modules


def imports_in(node: ast.AST, package: str, when: str = ALWAYS) -> Iterator[Import]:
    """Yield the imports below a node of a module of this package."""
    if isinstance(node, ast.Import):
        yield from (Import(alias.name, when) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        above = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
        origin = ".".join([*above, *([node.module] if node.module else [])])
        yield from (Import(f"{origin}.{alias.name}", when) for alias in node.names)
    elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
        for child in node.body:
            yield from imports_in(child, package, TYPING)
        for child in node.orelse:
            yield from imports_in(child, package, when)
    else:
        in_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.iter_child_nodes(node):
            yield from imports_in(child, package, FUNCTION if in_function else when)


def import_graph(modules: dict[str, Module], whens: Iterable[str]) -> Graph:
    """Return the modules that each module imports at these times.

    As in the import contracts, `from a import b` imports `a.b` if that is a module and `a`
    otherwise. The faces that Python runs on the way to a module do not count.
    """
    graph: Graph = {name: set() for name in modules}
    for module in modules.values():
        for found in module.imports:
            target = found.name if found.name in modules else found.name.rpartition(".")[0]
            if found.when in whens and target in modules and target != module.name:
                graph[module.name].add(target)
    return graph


def package_graph(modules: dict[str, Module], graph: Graph) -> Graph:
    """Return the packages that each package imports; each root module is one of its own."""
    packages = {
        name: name if module.package.endswith(ROOT_MODULES) else module.package
        for name, module in modules.items()
    }
    merged: Graph = {package: set() for package in packages.values()}
    for name, targets in graph.items():
        here = packages[name]
        merged[here] |= {packages[target] for target in targets} - {here}
    return merged


def circles(graph: Graph) -> list[list[str]]:
    """Return the strongly connected components of more than one node, the largest first."""
    reach = {node: reachable(graph, node) for node in graph}
    found = {frozenset(other for other in reach[node] if node in reach[other]) for node in graph}
    return sorted((sorted(circle) for circle in found if circle), key=lambda c: (-len(c), c))


def reachable(graph: Graph, start: str) -> set[str]:
    """Return the nodes to which at least one step leads from a start."""
    seen: set[str] = set()
    todo = [start]
    while todo:
        new = graph[todo.pop()] - seen
        seen |= new
        todo += new
    return seen


def layer_order(root: Path) -> list[str]:
    """Return the packages of the layers contracts, the lowest layer first."""
    settings = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))
    order = []
    for contract in settings.get("tool", {}).get("importlinter", {}).get("contracts", []):
        for layer in reversed(contract.get("layers", [])):
            names = layer.replace("|", " ").replace(":", " ").split()
            order += [
                f"{container}.{name.strip('()')}".lstrip(".")
                for container in contract.get("containers", [""])
                for name in names
            ]
    return order


def table(modules: dict[str, Module], order: list[str]) -> str:
    """Return one line per package, lowest layer first, and one per import root."""
    importers: Graph = {name: set() for name in modules}
    for name, targets in import_graph(modules, (ALWAYS, FUNCTION, FACE, TYPING)).items():
        for target in targets:
            importers[target].add(name)
    places = {name: place for place, name in enumerate(order)}
    lines = [
        f"{'modules imported by':>66}{'imports in':>20}",
        f"{'package':24}{'files':>6}{'lines':>9}{'median':>8}{'none':>7}{'one':>6}{'more':>6}"
        f"{'reached':>9}{'functions':>12}{'typing':>8}",
    ]
    for top in FOLDERS:
        own = [module for module in modules.values() if module.name.split(".")[0] == top]
        by_package: dict[str, list[Module]] = {}
        for module in own:
            by_package.setdefault(module.package, []).append(module)
        lines.append("-" * len(lines[1]))
        for package in sorted(
            by_package,
            key=lambda name: (name.endswith(ROOT_MODULES), places.get(name, len(places)), name),
        ):
            lines.append(row(package, by_package[package], modules, importers))
        if own:
            lines.append(row(top, own, modules, importers))
    return "\n".join(lines)


def row(label: str, members: list[Module], modules: dict[str, Module], importers: Graph) -> str:
    """Return the table's line of these modules."""
    counts = [len(importers[module.name]) for module in members]
    reached = sum(
        any(modules[name].package != module.package for name in importers[module.name])
        for module in members
        if not (module.is_face or module.package.endswith(ROOT_MODULES))
    )
    imports = [found for module in members for found in module.imports]
    inside = [found.is_own for found in imports if found.when == FUNCTION]
    typing = sum(found.is_own for found in imports if found.when == TYPING)
    return (
        f"{label:24}{len(members):6}{sum(m.lines for m in members):9,}"
        f"{median(m.lines for m in members):8.0f}"
        f"{counts.count(0):7}{counts.count(1):6}{sum(count > 1 for count in counts):6}"
        f"{reached:9}{f'{sum(inside)} / {len(inside) - sum(inside)}':>12}{typing:8}"
    )


def circles_text(modules: dict[str, Module]) -> str:
    """Return how many import circles there are, and those that run-time imports make."""
    lines = [f"{'import circles':46}{'of modules':>16}{'of packages':>18}"]
    for label, whens in (
        ("by imports at the top of modules", (ALWAYS,)),
        ("and by those inside functions", (ALWAYS, FUNCTION)),
        ("and by the names that faces list", (ALWAYS, FUNCTION, FACE)),
        ("and by those under `if TYPE_CHECKING`", (ALWAYS, FUNCTION, FACE, TYPING)),
    ):
        graph = import_graph(modules, whens)
        found = circles(graph), circles(package_graph(modules, graph))
        lines.append(f"{label:46}{sizes(found[0]):>16}{sizes(found[1]):>18}")
    graph = import_graph(modules, (ALWAYS, FUNCTION, FACE))
    for heading, found in (
        ("circles of packages and root modules", circles(package_graph(modules, graph))),
        ("circles of modules", circles(graph)),
    ):
        if found:
            lines += ["", f"{heading}, but for type checking:"]
        for circle in found:
            text = f"{len(circle):3}  {' '.join(circle)}"
            lines.append(fill(text, WIDTH, subsequent_indent=" " * 5, break_on_hyphens=False))
    return "\n".join(lines)


def sizes(found: list[list[str]]) -> str:
    """Return the number of circles and the size of the largest."""
    return f"{len(found)}, largest {len(found[0])}" if found else "none"


def main() -> None:
    """Print the shape of a checkout."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    here = Path(__file__).parents[2]
    parser.add_argument("root", nargs="?", type=Path, default=here, help="a checkout of hil")
    root = parser.parse_args().root
    modules, order = read_modules(root), layer_order(root)
    listed = "lowest layer first" if order else "alphabetic: there is no layers contract"
    text = f"Packages, {listed}\n\n{table(modules, order)}\n\n{LEGEND}\n\n{circles_text(modules)}\n"
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
