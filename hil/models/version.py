"""Version of a model: the folder `NAME/v0001/` with the model's files and `version.json`.

The folder of a version is created atomically by one rename, and its files are never written again.
`version.json` contains the digest of each model file, so a changed file is detected (`verify`).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import RegistryError, card, fsync_directory, json_document, write_whole

VERSION_FILE = "version.json"
FORMAT = 1

_FOLDER = re.compile(r"v(\d{4,})\Z")


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """Version of a model.

    Attributes:
        name: Name of the model.
        number: Number of the version, from 1.
        folder: Folder of the model files, in the form that `load_model_file` reads.
        digest: SHA-256 over the files of the model; identical models have identical digests.
        registered: Time of the registration, UTC, ISO 8601.
        by: User who registered the version.
        facts: Origin of the model, as far as known: estimator, robot, serial number, training
            sources with their digests, run, evaluation and provenance.
        files: Mapping from the name of every file of the version, except `version.json`, to its
            SHA-256.
    """

    name: str
    number: int
    folder: Path
    digest: str
    registered: str
    by: str
    facts: Mapping[str, Any]
    files: Mapping[str, str]

    @property
    def label(self) -> str:
        """Label of the version, such as `v3`."""
        return f"v{self.number}"

    def __repr__(self) -> str:
        return f"<ModelVersion {self.name} {self.label}: {self.facts.get('estimator', '')}>"

    def _repr_html_(self) -> str:
        """Return the notebook card of the version."""
        facts = {
            "estimator": self.facts.get("estimator"),
            "robot": self.facts.get("robot"),
            "serial": self.facts.get("serial"),
            "registered": f"{self.registered[:16]} UTC by {self.by}",
            "run": (self.facts.get("run") or {}).get("folder"),
            "digest": self.digest[:12],
        }
        return card("Model", f"{self.name} {self.label}", facts)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `version.json` and the folder as a JSON object."""
        return _document(self) | {"folder": str(self.folder)}

    def verify(self) -> None:
        """Check every file of the version against its digest.

        Raises:
            RegistryError: A file of the version is missing, unreadable or changed.
        """
        for name, digest in self.files.items():
            try:
                now = hashlib.sha256((self.folder / name).read_bytes()).hexdigest()
            except OSError as error:
                raise self._damaged(f"{name} cannot be read: {error.strerror}") from error
            if now != digest:
                raise self._damaged(f"{name} was changed after its registration")

    def _damaged(self, what: str) -> RegistryError:
        return RegistryError(
            f"{self.name} {self.label}: {what}",
            hint=f"restore {self.folder} from a backup; versions never change",
        )


def folder_of(home: Path, number: int) -> Path:
    """Return the path of the folder of a version."""
    return home / f"v{number:04d}"


def numbers_in(home: Path) -> list[int]:
    """Return the numbers of the existing versions of a name, in ascending order.

    Version folders that a crash left unfinished have different names and are ignored.
    """
    if not home.is_dir():
        return []
    matches = (_FOLDER.match(path.name) for path in home.iterdir())
    return sorted(int(match[1]) for match in matches if match)


def read_version(home: Path, number: int) -> ModelVersion:
    """Read a version from its folder.

    Raises:
        RegistryError: The version does not exist, or it is damaged.
    """
    path = folder_of(home, number) / VERSION_FILE
    try:
        document = json.loads(path.read_bytes())
        if document["hil_version"] != FORMAT:
            raise ValueError(f"format {document['hil_version']!r}")
        return ModelVersion(
            name=str(document["name"]),
            number=int(document["number"]),
            folder=path.parent,
            digest=str(document["digest"]),
            registered=str(document["registered"]),
            by=str(document["by"]),
            facts=dict(document["facts"]),
            files={str(name): str(digest) for name, digest in document["files"].items()},
        )
    except FileNotFoundError as error:
        raise RegistryError(
            f"{home.name} has no version {number}",
            hint=f"see its versions: hil models show {home.name}",
        ) from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise RegistryError(
            f"{path} cannot be read: {error}", hint="restore the folder from a backup"
        ) from error


def write_version(home: Path, version: ModelVersion, files: Mapping[str, bytes]) -> None:
    """Create the folder of a version, with all its files, atomically.

    Raises:
        RegistryError: The folder of the version cannot be written.
    """
    draft = home / f".{version.folder.name}.{os.getpid()}"
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        for name, content in {**files, VERSION_FILE: json_document(_document(version))}.items():
            path = draft / name
            write_whole(path, content)
            path.chmod(0o444)
        fsync_directory(draft)
        draft.rename(version.folder)
        fsync_directory(home)
    except OSError as error:
        raise RegistryError(
            f"cannot write {version.folder}: {error.strerror}",
            hint="check that the folder is writable and that the disk has space",
        ) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def digest_of(files: Mapping[str, bytes]) -> str:
    """Return the SHA-256 over names and contents of files, in the order of the names."""
    whole = hashlib.sha256()
    for name in sorted(files):
        whole.update(f"{name} {hashlib.sha256(files[name]).hexdigest()}\n".encode())
    return whole.hexdigest()


def _document(version: ModelVersion) -> dict[str, Any]:
    return {
        "hil_version": FORMAT,
        "name": version.name,
        "number": version.number,
        "digest": version.digest,
        "registered": version.registered,
        "by": version.by,
        "facts": dict(version.facts),
        "files": dict(version.files),
    }
