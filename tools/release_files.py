"""Build sdist and wheel so that the same commit gives the same bytes: `python tools/release_files.py dist`.

setuptools leaves times, owners and rights of the checkout's files in the archives. The sdist is packed anew
with those of the last commit, of root and of plain files; the wheel is built from it.
"""

from __future__ import annotations

import gzip
import io
import os
import stat
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
_BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build(root: Path, target: Path, epoch: int) -> tuple[Path, Path]:
    """Build into the folder `target`; the sdist and the wheel. epoch: time of all files, s."""
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        made = _setuptools(root, "build_sdist", folder, epoch)
        sdist = target / made.name
        sdist.write_bytes(packed_anew(made, epoch))
        with tarfile.open(sdist) as archive:
            archive.extractall(folder / "unpacked", filter="data")
        unpacked = next((folder / "unpacked").iterdir())
        wheel = _setuptools(unpacked, "build_wheel", target.absolute(), epoch)
    return sdist, wheel


def packed_anew(sdist: Path, epoch: int) -> bytes:
    """Pack an archive anew: names in order, one time, one owner, rights 644 or 755."""
    packed = io.BytesIO()
    with (
        tarfile.open(sdist) as source,
        gzip.GzipFile(filename="", fileobj=packed, mode="wb", mtime=epoch) as stream,
        tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for member in sorted(source.getmembers(), key=lambda member: member.name):
            plain = tarfile.TarInfo(member.name)
            plain.type, plain.size, plain.mtime = member.type, member.size, epoch
            plain.mode = 0o755 if member.isdir() or member.mode & stat.S_IXUSR else 0o644
            archive.addfile(plain, source.extractfile(member) if member.isfile() else None)
    return packed.getvalue()


def _setuptools(root: Path, hook: str, target: Path, epoch: int) -> Path:
    environment = os.environ | {"SOURCE_DATE_EPOCH": str(epoch), "PYTHONHASHSEED": "0"}
    command = [sys.executable, "-c", _BUILD, hook, str(target)]
    done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return target / done.stdout.splitlines()[-1]


def last_commit_epoch() -> int:
    """Return the time of the last commit, s."""
    command = ["git", "log", "-1", "--format=%ct"]
    return int(subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout)


if __name__ == "__main__":
    for path in build(ROOT, Path(sys.argv[1]), last_commit_epoch()):
        sys.stdout.write(f"written: {path}\n")
