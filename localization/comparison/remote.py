"""Logs in object stores: a copy of what an fsspec URL names, for as long as it is read (extra `fleet`)."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from localization.errors import LogError, TransportError

_TRIES = 3
_FIRST_PAUSE_S = 1.0
"""After a read that failed; doubled each time."""


class AccessError(TransportError):
    """A store that does not answer, after several tries."""


def is_url(name: str) -> bool:
    """Whether ``name`` is a URL as ``s3://bucket/drive.mcap``, and no path."""
    return "://" in name


def url_fingerprint(url: str) -> str:
    """Digits that change with the object: of its checksum or, by what the store has, its size and time. Raises as `local_copy`."""
    files, path = _open(url)
    return hashlib.sha256(str(repeated(url, lambda: files.ukey(path))).encode()).hexdigest()


@contextlib.contextmanager
def local_copy(name: str, folder: Path) -> Iterator[Path]:
    """Path of the log or file ``name``: in ``folder`` where it is a relative path, or a copy of the URL that is removed at the end.

    Raises `LogError` where the store has no such object, `AccessError` where it does not answer, `TransportError` where a library for
    it is missing.
    """
    if not is_url(name):
        yield folder / name
        return
    files, path = _open(name)
    with tempfile.TemporaryDirectory(prefix="skidloc-copy-") as place:
        target = Path(place) / Path(path).name
        repeated(name, lambda: files.get(path, str(target), recursive=files.isdir(path)))
        yield target


def _open(url: str) -> tuple[Any, str]:
    """File system and path of ``url``."""
    try:
        import fsspec
    except ImportError as error:
        raise TransportError(f"'{url}' needs the extra 'fleet': pip install 'skidloc[fleet]' ({error}).") from error
    try:
        files, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:  # no library for this protocol, or no such protocol
        raise TransportError(f"'{url}' cannot be opened: {' '.join(str(error).split())}.") from error
    return files, path.rstrip("/")


def repeated(url: str, read: Any) -> Any:
    """What ``read`` returns; several tries where the store fails, none where it answers that there is nothing, or no permission."""
    for tries in range(1, _TRIES + 1):
        try:
            return read()
        except FileNotFoundError as error:
            raise LogError(f"log '{url}': the store has no such object.") from error
        except PermissionError as error:
            raise AccessError(f"log '{url}': the store gives no permission. Check the credentials.") from error
        except OSError as error:
            if tries == _TRIES:
                raise AccessError(f"log '{url}': the store did not answer {_TRIES} times ({error}).") from error
        time.sleep(_FIRST_PAUSE_S * 2.0 ** (tries - 1))
    raise AssertionError
