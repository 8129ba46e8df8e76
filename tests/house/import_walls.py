"""Import contract for `make walls`: only a package's face is imported from outside it."""

from __future__ import annotations

from typing import Any

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output


class PrivateModules(Contract):
    """Modules below the packages of a container may be imported within their package only.

    A package's face is its `__init__`. Import-linter's own `protected` contract would need one
    entry per package, and would not notice a new package.
    """

    type_name = "private_modules"

    container = fields.ModuleField()
    public_modules = fields.SetField(subfield=fields.ModuleField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Find every direct import of a private module from outside its package."""
        container: Any = self.container
        public = {module.name for module in self.public_modules or ()}  # type: ignore[attr-defined]
        broken = [
            detail
            for package in sorted(graph.find_children(container.name))
            for module in sorted(graph.find_descendants(package) - public)
            for importer in sorted(graph.find_modules_that_directly_import(module))
            if not f"{importer}.".startswith(f"{package}.")
            for detail in graph.get_import_details(importer=importer, imported=module)
        ]
        return ContractCheck(kept=not broken, metadata={"broken": broken})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print one line per import."""
        for detail in check.metadata["broken"]:
            place = f"{detail['importer']}, line {detail['line_number']}"
            output.print_error(f"{place}: {detail['imported']} is private to its package")
