"""A contract for import-linter: an underscore module is imported by its own package only."""

import grimp
from importlinter import Contract, ContractCheck, fields, output


class PrivateModules(Contract):
    """Forbid imports of another package's underscore modules.

    Attributes
    ----------
    container
        Package whose inner packages keep their underscore modules private.
    """

    type_name = "private_modules"

    container = fields.StringField()

    def check(self, graph: grimp.ImportGraph, verbose: bool) -> ContractCheck:  # noqa: ARG002
        """Check every module with a part of its path that begins with an underscore."""
        depth = str(self.container).count(".") + 1
        found = []
        for module in sorted(graph.modules):
            parts = module.split(".")
            if len(parts) <= depth or not any(part.startswith("_") for part in parts[depth:]):
                continue
            if not module.startswith(f"{self.container}."):
                continue
            for importer in sorted(graph.find_modules_that_directly_import(module)):
                if importer.split(".")[: depth + 1] == parts[: depth + 1]:
                    continue
                details = graph.get_import_details(importer=importer, imported=module)
                found += [(importer, d["line_number"], module) for d in details]
        return ContractCheck(kept=not found, metadata={"found": found})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print one line for each forbidden import."""
        for importer, line, module in check.metadata["found"]:
            output.print_error(
                f"{importer}:{line} imports {module}, which belongs to its own package: "
                "import the name from the package's face, or make the module public",
                bold=False,
            )
