"""Read pictures stored as separate files: EuRoC's and KITTI's folders."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from pathlib import Path

from barsight.calibration.geometry.rig import StereoRig
from barsight.core.records.gray_levels import TornImageError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.recording.own_files import read_picture
from barsight.recording.pairing import PairedAtOpening, decode_for
from barsight.recording.stored_images import StoredImage, merge_cameras


class PictureFiles(PairedAtOpening):
    """The part of a `Recording` that reads pictures; the reader sets the attributes below.

    _root: the folder to which file names in refusals are relative. _left, _right: a file for each pair's
    stamp.
    """

    rig: StereoRig
    path: Path
    _root: Path
    _left: Sequence[Path]
    _right: Sequence[Path]

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield frames; see `Recording.frames`."""
        pairing = self._pairs.pairing
        for stamp, left, right in zip(self.index.stamps_ns, pairing.left, pairing.right, strict=True):
            if wanted is None or stamp in wanted:
                yield self._read_pair(stamp, self._left[left], self._right[right])

    def absent(self) -> tuple[Path, ...]:
        """List the pictures that are not there; see `NamedPictures.absent`."""
        return tuple(
            path.relative_to(self._root) for path in (*self._left, *self._right) if not path.is_file()
        )

    def stored_images(self) -> Iterator[StoredImage]:
        """Yield the stored bytes of every readable picture, both cameras in time order."""
        for camera, stamp, path in merge_cameras(self._pairs, self._left, self._right):
            try:
                data = read_picture(path, self.path)
            except (FileNotFoundError, TornImageError):
                continue
            yield StoredImage(camera, stamp, path.suffix.lstrip(".").lower(), data)

    def _read_pair(self, stamp_ns: int, left: Path, right: Path) -> StereoFrame | RefusedFrame:
        """Read one pair; it is refused, with the file's name, if either picture can't be used."""
        images = []
        for path, camera in ((left, self.rig.cam0), (right, self.rig.cam1)):
            name = path.relative_to(self._root)
            try:
                images.append(decode_for(camera, read_picture(path, self.path)))
            except FileNotFoundError:
                return RefusedFrame(stamp_ns, f"{name} is missing")
            except TornImageError as error:
                return RefusedFrame(stamp_ns, f"{name} {error}")
        return StereoFrame(stamp_ns, images[0], images[1])
