"""Build hook: the wheel's bill of materials (PEP 770, CycloneDX 1.7), made of the declared dependencies.

The wheel has no code of others. Each dependency is external: the environment provides it, in the declared range.
"""

import json
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.requirements import Requirement


def component(requirement: str, scope: str) -> dict[str, Any]:
    """A dependency as a component with its range of versions."""
    of = Requirement(requirement)
    bounds = sorted(map(str, of.specifier), key=lambda bound: bound.startswith("<"))
    purl = f"pkg:pypi/{of.name.lower()}"
    external = {"isExternal": True, "versionRange": f"vers:pypi/{'|'.join(bounds)}"}
    return {"type": "library", "bom-ref": purl, "name": of.name, "purl": purl, "scope": scope, **external}


class CustomBuildHook(BuildHookInterface):
    """Writes the bill where the wheel is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the bill to a wheel; hatchling calls it."""
        core, own = self.metadata.core, f"pkg:pypi/{self.metadata.core.name}@{self.metadata.version}"
        optional = [one for extra in ("camera", "ros") for one in core.optional_dependencies[extra]]
        used = [component(one, "required") for one in core.dependencies]
        used += [component(one, "optional") for one in optional]
        package = {"type": "library", "bom-ref": own, "name": core.name, "version": self.metadata.version, "purl": own}
        package["licenses"] = [{"license": {"id": core.license_expression}}]
        bill = {
            "$schema": "http://cyclonedx.org/schema/bom-1.7.schema.json",
            "bomFormat": "CycloneDX",
            "specVersion": "1.7",
            "version": 1,
            "metadata": {"component": package},
            "components": used,
            "dependencies": [{"ref": own, "dependsOn": [one["bom-ref"] for one in used]}],
        }
        self.file = Path(mkdtemp()) / f"{core.name}.cdx.json"
        self.file.write_text(json.dumps(bill, indent=2) + "\n", encoding="utf-8")
        build_data["sbom_files"].append(str(self.file))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file that was put into the wheel; hatchling calls it."""
        self.file.unlink()
        self.file.parent.rmdir()
