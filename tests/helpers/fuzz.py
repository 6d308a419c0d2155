"""Log files changed by hypothesis (bits flipped, cut, moved): a reader reads or refuses them in bounded time."""

from __future__ import annotations

import functools
import tempfile
import time
from pathlib import Path

from hypothesis import strategies as st

from localization.errors import LogError
from localization.logs import inspect_log, open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.logs import records_of_every_kind

ROBOT = load_robot("vaultbot")
MOST_SECONDS = 10.0
"""For a log of 40 steps, which is read in a tenth of a second."""

CHANGES = st.lists(
    st.tuples(
        st.sampled_from(("flip", "set", "zero", "move", "cut", "ones")),
        st.floats(0.0, 1.0, exclude_max=True),
        st.floats(0.0, 1.0, exclude_max=True),
        st.integers(0, 255),
    ),
    min_size=1,
    max_size=6,
)
"""Change, position, source position (both as fractions of the file), and a byte."""


@functools.cache
def valid_files(form: str) -> dict[str, bytes]:
    """The files of a small log with all sensors, by name; a bare file has the name "run"."""
    with tempfile.TemporaryDirectory() as name:
        path = bags.FORMATS[form](Path(name) / "run", [r for r in records_of_every_kind() if not isinstance(r[1], bags.Unknown)])
        files = path.iterdir() if path.is_dir() else [path]
        return {file.name: file.read_bytes() for file in files}


def changed(data: bytes, changes: list[tuple[str, float, float, int]]) -> bytes:
    out = bytearray(data)
    for what, place, whence, byte in changes:
        if not out:
            break
        at, other = int(place * len(out)), int(whence * len(out))
        if what == "flip":
            out[at] ^= 1 << byte % 8
        elif what == "set":
            out[at] = byte
        elif what == "zero":
            out[at : at + byte] = bytes(len(out[at : at + byte]))
        elif what == "move":
            out[at : at + byte] = out[other : other + byte]
        elif what == "ones":
            out[at : at + 8] = b"\xff" * len(out[at : at + 8])
        else:
            del out[at:]
    return bytes(out)


def check(form: str, changes: list[tuple[str, float, float, int]], of_metadata: bool = False) -> None:
    """Read a changed log wholly. Errors other than `LogError` are raised."""
    files = valid_files(form)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run" if len(files) > 1 else Path(name)
        folder.mkdir(exist_ok=True)
        for file, data in files.items():
            is_changed = (file == "metadata.yaml") == of_metadata or len(files) == 1
            (folder / file).write_bytes(changed(data, changes) if is_changed else data)
        begin = time.monotonic()
        try:
            log = open_log(folder if len(files) > 1 else folder / next(iter(files)), ROBOT)
            stamps = [event.stamp_ns for event in log.events()]
            inspect_log(log)
        except LogError:
            stamps = []
        assert stamps == sorted(stamps)
        assert time.monotonic() - begin < MOST_SECONDS
