"""The trajectory sets as one archive, which lies beside a release: they are ten times as large as the package.

The package holds ``manifest.json`` with the SHA-256 of every file; what an archive holds is compared with it before it
is stored. Where the files are looked for: ``trajectory_sets.shipped``.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

from sipe_bayes.core.files import reading, write_bytes
from sipe_bayes.datasets.trajectory_sets import (
    IN_PACKAGE,
    MANIFEST,
    TrajectorySetError,
    data_folder,
    manifest,
    shipped,
    verify,
)

_DATE = (1980, 1, 1, 0, 0, 0)  # of every member, so that the same sets give the same bytes


def pack(out: Path, folder: Path | None = None) -> str:
    """Write trajectory sets and their manifest as a zip file.

    Args:
        out: the file.
        folder: of the sets; default those that are installed.

    Returns:
        The archive's SHA-256.

    Raises:
        TrajectorySetError: where the folder is not as its manifest says.
    """
    folder = folder or shipped()
    wrong = verify(folder)
    if wrong:
        raise TrajectorySetError(wrong[0])
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for file in (*sorted(manifest(folder)), MANIFEST):
            archive.writestr(zipfile.ZipInfo(file, _DATE), (folder / file).read_bytes())
    write_bytes(out, buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def install(archive: Path) -> Path:
    """Store an archive's trajectory sets where ``trajectory_sets.shipped`` looks for them.

    Args:
        archive: what ``pack`` wrote, of this version.

    Returns:
        The folder.

    Raises:
        TrajectorySetError: for a file that is no such archive, or whose content the package's manifest does not know;
            then nothing is stored.
    """
    remedy = "take the archive that lies beside this version's release"
    wanted, folder = manifest(IN_PACKAGE), data_folder() / "trajectories"
    with (
        reading(archive, "an archive of trajectory sets", remedy, TrajectorySetError),
        zipfile.ZipFile(archive) as opened,
    ):
        content = {}
        for file, entry in wanted.items():
            with opened.open(file) as member:
                content[file] = member.read(entry.bytes + 1)  # no more, whatever it claims
    for file, entry in wanted.items():
        if hashlib.sha256(content[file]).hexdigest() != entry.sha256:
            raise TrajectorySetError(f"{archive}: the SHA-256 of {file} is not the manifest's; {remedy}")
    for file in wanted:
        write_bytes(folder / file, content[file])
    write_bytes(folder / MANIFEST, (IN_PACKAGE / MANIFEST).read_bytes())
    return folder
