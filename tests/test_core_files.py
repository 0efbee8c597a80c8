"""Outputs whole or not at all, whatever goes wrong in the middle."""

import errno
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from barsight.core.errors import InputError, OutputError
from barsight.core.files import atomic_directory, atomic_path, atomic_paths, held_folder

FAILURES = [RuntimeError("bug"), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


def test_a_file_appears_whole(tmp_path: Path) -> None:
    target = tmp_path / "height.tif"
    target.write_text("old")
    with atomic_path(target) as path:
        path.write_text("half")
        assert target.read_text() == "old"
        path.write_text("new")
    assert target.read_text() == "new"
    assert names(tmp_path) == ["height.tif"]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
def test_a_failure_leaves_the_old_file(tmp_path: Path, failure: BaseException) -> None:
    target = tmp_path / "height.tif"
    target.write_text("old")
    with pytest.raises((type(failure), OutputError)), atomic_path(target) as path:
        path.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert names(tmp_path) == ["height.tif"]


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
def test_a_failure_leaves_no_half_folder(tmp_path: Path, failure: BaseException, exists: bool) -> None:
    out = tmp_path / "out"
    if exists:
        out.mkdir()
        (out / "a").write_text("old")
    with pytest.raises((type(failure), OutputError)), atomic_directory(out, replace=True) as folder:
        (folder / "a").write_text("new")
        (folder / "deep").mkdir()
        (folder / "deep" / "b").write_text("new")
        raise failure
    assert names(tmp_path) == (["a", "out"] if exists else [])
    assert not exists or (out / "a").read_text() == "old"


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, data: str) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))

    out = tmp_path / "out"
    with pytest.raises(OutputError) as caught, atomic_directory(out) as folder:
        monkeypatch.setattr(Path, "write_text", full)
        (folder / "a").write_text("x")
    assert str(caught.value) == f"{out}: the disk is full; free some space or name another folder"
    assert caught.value.exit_code == 4
    assert names(tmp_path) == []


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with atomic_directory(out) as folder:
        (folder / "a").write_text("1")
        assert not out.exists()
    assert names(tmp_path) == ["a", "deep", "out"]
    mask = os.umask(0)
    os.umask(mask)
    assert out.stat().st_mode & 0o777 == 0o777 & ~mask


def test_a_full_disk_names_the_file_that_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the temporary one, also where a page is written into a folder that isn't there yet."""

    def full(self: Path, data: str) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))

    monkeypatch.setattr(Path, "write_text", full)

    def write(target: Path) -> None:
        with atomic_path(target) as path:
            path.write_text("x")

    with pytest.raises(OutputError) as caught, atomic_directory(tmp_path / "out") as folder:
        write(folder / "page.html")
    assert str(caught.value).startswith(f"{tmp_path / 'out' / 'page.html'}: the disk is full")
    with pytest.raises(OutputError) as caught, atomic_paths(tmp_path / "a.yaml", tmp_path / "a.html") as two:
        write(two[1])
    assert str(caught.value).startswith(f"{tmp_path / 'a.html'}: the disk is full")


def test_an_empty_folder_is_filled_a_full_one_kept(tmp_path: Path) -> None:
    with atomic_directory(tmp_path) as folder:
        (folder / "a").write_text("1")
    with pytest.raises(OutputError, match="exists and is not empty"), atomic_directory(tmp_path):
        pytest.fail("the block must not run")
    with pytest.raises(OutputError, match="--overwrite"), atomic_directory(tmp_path, owned=("a",)):
        pytest.fail("the block must not run")
    assert names(tmp_path) == ["a"]


def test_replace_keeps_what_has_other_names(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "tiles").mkdir(parents=True)
    (out / "tiles" / "stale").write_text("old")
    (out / "a").write_text("old")
    (out / "mine").write_text("kept")
    with atomic_directory(out, replace=True) as folder:
        (folder / "a").write_text("new")
        (folder / "tiles").mkdir()
        (folder / "tiles" / "fresh").write_text("new")
    assert names(tmp_path) == ["a", "fresh", "mine", "out", "tiles"]
    assert (out / "a").read_text() == "new"
    assert (out / "mine").read_text() == "kept"


Opener = Callable[[Path], AbstractContextManager[Path]]


@pytest.mark.parametrize("opener", [atomic_path, atomic_directory])
def test_a_target_below_a_file(tmp_path: Path, opener: Opener) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="a part of the path is a file"),
        opener(tmp_path / "file" / "x") as path,
    ):
        path.write_text("x")
    assert names(tmp_path) == ["file"]


def test_a_target_of_the_wrong_kind(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="is a file; name a folder"), atomic_directory(tmp_path / "file"):
        pytest.fail("the block must not run")
    with pytest.raises(OutputError, match="is a folder"), atomic_path(tmp_path / "folder") as path:
        path.write_text("x")
    assert names(tmp_path) == ["file", "folder"]


def test_a_missing_parent_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no folder"), atomic_path(tmp_path / "no" / "x") as path:
        path.write_text("x")
    assert names(tmp_path) == []


@pytest.mark.parametrize("opener", [atomic_path, atomic_directory])
def test_a_place_that_takes_no_files(opener: Opener) -> None:
    """The system's word for it names our temporary file, which says nothing to the user."""
    line = r"^/proc/x: nothing can be written there \(No such file or directory\); name another folder$"
    with pytest.raises(OutputError, match=line), opener(Path("/proc/x")) as path:
        path.write_text("x")


def test_a_file_that_is_missing_elsewhere_is_no_output(tmp_path: Path) -> None:
    for lacking in ("recording.csv", "out/height.tif"):
        with pytest.raises(FileNotFoundError), atomic_directory(tmp_path / "out"):
            (tmp_path / lacking).read_text()
    assert names(tmp_path) == []


@pytest.mark.parametrize("inside", ["out", "out/part", ".out.x1.part/part", "."])
def test_a_refusal_names_the_side_that_it_is_about(tmp_path: Path, inside: str) -> None:
    target = tmp_path / "out"
    with pytest.raises(OutputError, match=r"out: no permission to write"), atomic_directory(target):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / inside))
    with pytest.raises(InputError, match=r"data.csv: no permission to read"), atomic_directory(target):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "recording" / "data.csv"))


def test_a_folder_is_held_for_one_process_and_is_gone_if_nothing_came_into_it(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with held_folder(out), pytest.raises(OutputError, match="another run is writing there"), held_folder(out):
        pass
    assert list(tmp_path.iterdir()) == []
    with held_folder(out):
        (out / "kept").touch()
    with held_folder(out), pytest.raises(OutputError, match="is a file"), held_folder(out / "kept"):
        pass
    assert [path.name for path in out.iterdir()] == ["kept"]
