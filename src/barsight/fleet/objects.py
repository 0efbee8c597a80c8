"""Read and write objects of a folder, S3, Azure or Google storage; the only module that uses obstore."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError, InputError, OutputError
from barsight.core.extras import extra
from barsight.core.files import translated_os_errors
from barsight.core.reading.bounded_reading import MAX_DOCUMENT_BYTES, open_regular, parse_json
from barsight.core.reading.json_schema import expect_schema

with extra("fleet"):
    import obstore
    from obstore.exceptions import AlreadyExistsError, BaseError
    from obstore.store import LocalStore, ObjectStore, from_url

REMEDY = "remove it, or write it anew"
RETRY_S = 180
"""Time in seconds for which a refused or lost request is retried."""
_LARGE = 8 << 20


class UnreachableError(InputError):
    """Storage that does not answer, or refuses its keys; no object in it is at fault."""


@dataclass(frozen=True)
class StoredObject:
    """An object of a listing. mark: changes whenever the content does."""

    path: str
    size: int
    mark: str


@dataclass(frozen=True)
class Objects:
    """Objects under one URL. url: of a folder, s3://, az:// or gs://.

    The URL contains no keys; they come from the environment.
    """

    url: str
    store: ObjectStore

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        """List all objects under a prefix that ends with a slash."""
        with _translated_errors(self.url):
            for part in obstore.list(self.store, prefix.rstrip("/") or None):
                yield from map(_listed, part)

    def list_folder(self, prefix: str) -> Iterator[StoredObject]:
        """List the objects directly in a folder."""
        with _translated_errors(self.url):
            for one in obstore.list_with_delimiter(self.store, prefix or None)["objects"]:
                yield _listed(one)

    def read(self, path: str) -> bytes | None:
        """Read a small object; None if there is none. Raises InputError above MAX_DOCUMENT_BYTES."""
        with _translated_errors(f"{self.url}/{path}"):
            try:
                found = self._get(path)
            except FileNotFoundError:
                return None
            self.expect_size(path, found.meta["size"], MAX_DOCUMENT_BYTES)
            return bytes(found.bytes())

    def expect_size(self, path: str, size: int, max_bytes: int) -> None:
        """Raise InputError if an object has more bytes than `max_bytes`."""
        if size > max_bytes:
            raise InputError(f"{self.url}/{path}", f"has {size} bytes, at most {max_bytes} are read", REMEDY)

    def read_json(self, path: str, schema: Any = None) -> Any:
        """Read a JSON object; None if there is none. Raises InputError if it is damaged or violates the
        schema.
        """
        data = self.read(path)
        if data is None:
            return None
        content = parse_json(data, f"{self.url}/{path}", REMEDY)
        if schema is not None:
            expect_schema(content, schema, f"{self.url}/{path}", REMEDY)
        return content

    def write(self, path: str, data: bytes | Path) -> None:
        """Write an object, replacing any existing one. data: or a file. Raises OutputError if this fails."""
        with _translated_errors(f"{self.url}/{path}", writes=True):
            obstore.put(self.store, path, data)

    def write_new(self, path: str, data: bytes) -> bool:
        """Write an object only if there is none; return True if the object is this writer's.

        data: must identify its writer: a put whose answer was lost is retried and finds itself. Raises
        OutputError if this fails.
        """
        with _translated_errors(f"{self.url}/{path}", writes=True):
            try:
                obstore.put(self.store, path, data, mode="create")
            except AlreadyExistsError:
                return self.read(path) == data
        return True

    def remove(self, path: str) -> None:
        """Remove an object, if it still exists."""
        with _translated_errors(f"{self.url}/{path}"):
            try:
                obstore.delete(self.store, path)
            except FileNotFoundError:
                return

    def chunks(self, path: str) -> Iterator[bytes]:
        """Read a large object in parts. Raises InputError if there is none."""
        with _translated_errors(f"{self.url}/{path}"):
            try:
                found = self._get(path)
            except FileNotFoundError:
                raise InputError(f"{self.url}/{path}", "is gone", "plan the archive again") from None
            for part in found.stream(min_chunk_size=_LARGE):
                yield bytes(part)

    def _get(self, path: str) -> Any:
        """Open an object. In a folder it must be a regular file, since reading a pipe could block."""
        file = Path(self.url) / path
        if isinstance(self.store, LocalStore) and file.exists():
            open_regular(file).close()
        return obstore.get(self.store, path)


def open_objects(url: str, *, create: bool = False) -> Objects:
    """Open a folder or a bucket. create: make a missing folder.

    Raises ConfigError for an invalid URL, InputError for a missing folder.
    """
    if "://" in url and not url.startswith("file://"):
        options = {"allow_http": True} if _is_plain(os.environ.get("AWS_ENDPOINT_URL", "")) else None
        waits = {"init_backoff": timedelta(seconds=0.2), "max_backoff": timedelta(seconds=5), "base": 2}
        retry = {"max_retries": 1000, "retry_timeout": timedelta(seconds=RETRY_S), "backoff": waits}
        try:
            return Objects(url.rstrip("/"), from_url(url, client_options=options, retry_config=retry))  # type: ignore[call-overload]
        except (BaseError, ValueError) as error:
            raise ConfigError(f"{url}: can't be opened ({_first_line(error)})") from error
    folder = Path(url.removeprefix("file://")).absolute()
    if not folder.is_dir():
        if not create:
            problem = "is a file" if folder.is_file() else "there is no such folder"
            raise InputError(folder, problem, "name the folder, or s3://BUCKET/PATH")
        with translated_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
    return Objects(str(folder), LocalStore(folder))


def _listed(one: Any) -> StoredObject:
    return StoredObject(one["path"], one["size"], one["e_tag"] or one["last_modified"].isoformat())


def _is_plain(endpoint: str) -> bool:
    return endpoint.startswith("http://")


@contextmanager
def _translated_errors(name: str, *, writes: bool = False) -> Iterator[None]:
    """Turn the error of a server or disk into one line: InputError, or OutputError if it `writes`."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # obstore can't start a thread
            raise MemoryError from error
        if not isinstance(error, BaseError) and not (isinstance(error, OSError) and error.errno is None):
            raise
        problem = _first_line(error)
        if writes:
            message = f"{name}: can't be written ({problem}); free some space or set its keys"
            raise OutputError(message) from error
        remedy = "see that it is there and its keys are set"
        raise UnreachableError(name, f"can't be reached ({problem})", remedy) from error


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return re.sub(r"\s+", " ", lines[0])[:300]
