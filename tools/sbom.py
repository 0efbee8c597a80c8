"""Write a CycloneDX bill of materials: `python tools/sbom.py sbom.cdx.json`.

It lists what a user gets who installs the run time and every extra for users: the installed packages with
version, licence and what each needs, and the hashes of their files as `requirements-dev.lock` holds them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

from cyclonedx.model import ExternalReference, ExternalReferenceType, HashAlgorithm, HashType, XsUri
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import DisjunctiveLicense, LicenseExpression
from cyclonedx.output.json import JsonV1Dot6
from packageurl import PackageURL

from licences import ROOT, licence, packages, sections

LOCK = ROOT / "requirements-dev.lock"


def locked_hashes() -> dict[str, list[str]]:
    """Read the SHA-256 of each package's files from the lock."""
    blocks = re.split(r"\n(?=\S)", LOCK.read_text(encoding="utf-8").strip())
    return {re.split(r"[=\[]", block)[0]: re.findall(r"sha256:([0-9a-f]{64})", block) for block in blocks}


def described(name: str, hashes: Iterable[str], kind: ComponentType = ComponentType.LIBRARY) -> Component:
    """Describe an installed package. hashes: SHA-256 of its files, of which a platform takes one."""
    found = distribution(name)
    stated = licence(name)
    is_expression = "License-Expression" in found.metadata
    files = [HashType(alg=HashAlgorithm.SHA_256, content=digest) for digest in sorted(hashes)]
    page = XsUri(f"https://pypi.org/project/{name}/{found.version}/")
    references = [ExternalReference(type=ExternalReferenceType.DISTRIBUTION, url=page, hashes=files)]
    return Component(
        name=name, version=found.version, type=kind, bom_ref=name,
        licenses=[LicenseExpression(stated) if is_expression else DisjunctiveLicense(name=stated)],
        purl=PackageURL("pypi", name=name, version=found.version),
        external_references=references if files else (),
    )  # fmt: skip


def bill() -> Bom:
    """Collect the packages and what each needs of the others."""
    hashes = locked_hashes()
    parts = {
        name: described(name, hashes.get(name, ())) for name in sorted(set().union(*sections().values()))
    }
    bom = Bom(components=parts.values())
    bom.metadata.component = described("barsight", (), ComponentType.APPLICATION)
    bom.register_dependency(bom.metadata.component, parts.values())
    for name, part in parts.items():
        needed = packages([name]) - {name}
        bom.register_dependency(part, [parts[other] for other in sorted(needed & parts.keys())])
    return bom


if __name__ == "__main__":
    target = Path(sys.argv[1])
    JsonV1Dot6(bill()).output_to_file(str(target), allow_overwrite=True, indent=1)
    sys.stdout.write(f"written: {target}\n")
