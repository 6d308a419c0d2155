"""Files whose recorder's clock was set back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.logs.reader import open_source
from localization.logs.sqlite import SqliteFile
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

SET_AT_S, END_S = 12.0, 30.0


def records(back_s: float, step: Any = lambda topic, t: 0.0) -> list[Record]:
    """Wheels at 50 Hz and IMU at 100 Hz in order of recording; the clock is set back by ``back_s`` on the way."""
    found = []
    for i in range(round(100 * END_S)):
        t = i / 100
        stamp = START + round(t * S)
        log = stamp - round((back_s if t >= SET_AT_S else 0.0) * S)
        found.append(("/imu/data", bags.imu(stamp, (0.0, 0.0, 0.1)), log))
        if i % 2 == 0:
            found.append(("/joint_states", bags.joint_state(stamp, position=[t] * 4, velocity=[1.0] * 4), log))
    return found


def write(path: Path, found: list[Record], form: str) -> Path:
    if form == "sqlite3":
        return bags.write_ros2_bag(path, found, form)
    if form == "mcap":
        return bags.write_mcap(path.with_suffix(".mcap"), found)
    return bags.write_ros1_bag(path.with_suffix(".bag"), found, chunk_bytes=None if form == "ros1" else 8000)


@pytest.mark.parametrize(
    ("form", "back_s"),
    [
        ("sqlite3", 40.0),
        ("sqlite3", 2.5),
        ("mcap", 40.0),
        ("mcap", 2.5),
        ("ros1", 40.0),
        ("ros1", 2.5),
        ("ros1 of small chunks", 40.0),
        ("ros1 of small chunks", 2.5),
    ],
)
def test_set_back_clock_messages_keep_the_order_of_recording(tmp_path: Path, form: str, back_s: float) -> None:
    source = open_source(write(tmp_path / "log", records(back_s), form))
    times = np.array([message.log_ns for message in source.messages(["/imu/data"])])
    steps = np.diff(times) / S
    assert len(times) == 3000
    assert (source.end_ns - source.start_ns) / S == pytest.approx(END_S, abs=0.05)
    np.testing.assert_allclose(steps, 0.01, atol=0.011)
    (warning,) = source.warnings
    assert f"set back by {back_s:.1f} s, {SET_AT_S:.1f} s after the start" in warning


def test_set_back_clock_file_of_topic_after_topic_is_left_as_it_is(tmp_path: Path) -> None:
    found = sorted(records(0.0), key=lambda record: record[0])
    source = open_source(write(tmp_path / "log", found, "ros1 of small chunks"))
    times = [message.log_ns for message in source.messages(["/imu/data", "/joint_states"])]
    assert source.warnings == []
    assert times == sorted(record[2] for record in found)


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_set_back_clock_single_message_of_a_wrong_time_is_no_step(tmp_path: Path, form: str) -> None:
    found = records(0.0)
    topic, message, log = found[2000]
    found[2000] = topic, message, log - 20 * S
    source = open_source(write(tmp_path / "log", found, form))
    assert source.warnings == []


def test_set_back_clock_rows_behind_later_damage_are_kept(tmp_path: Path) -> None:
    """They are read page by page, and moved like all others."""
    (path,) = write(tmp_path / "log", records(40.0), "sqlite3").glob("*.db3")
    source = SqliteFile(path)
    data = bytearray(path.read_bytes())
    size = int.from_bytes(data[16:18], "big")
    leaves = [at for at in range(size, len(data), size) if data[at] == 13]
    at = leaves[len(leaves) * 8 // 10]  # of the table of messages, after the step at 12 of 30 s
    data[at : at + size] = b"\xff" * size
    path.write_bytes(data)
    times = np.array([message.log_ns for message in source.messages(["/imu/data"])])
    assert "page by page" in source.warnings[-1]
    assert len(times) > 2900
    assert (times[-1] - times[0]) / S == pytest.approx(END_S, abs=0.05)


def split_bag(folder: Path, parts: list[list[Record]], form: str) -> Path:
    """A recording of several files, as a recorder splits it, whose metadata.yaml names them in order."""
    folder.mkdir()
    names = []
    for i, part in enumerate(parts):
        (file,) = (p for p in bags.write_ros2_bag(folder.parent / f"part_{i}", part, form).iterdir() if p.suffix != ".yaml")
        names.append(f"log_{i}{file.suffix}")
        file.rename(folder / names[-1])
    listed = "".join(f"\n  - {name}" for name in names)
    count = sum(len(part) for part in parts)
    text = f"rosbag2_bagfile_information:\n  message_count: {count}\n  relative_file_paths:{listed}\n"
    (folder / "metadata.yaml").write_text(text)
    return folder


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
@pytest.mark.parametrize("back_s", [2.5, 40.0, 9000.0])
def test_set_back_clock_between_two_files_later_ones_are_moved(tmp_path: Path, form: str, back_s: float) -> None:
    found = records(back_s)
    cut = round(150 * SET_AT_S)
    parts = [found[: cut // 2], found[cut // 2 : cut], found[cut : cut + 600], found[cut + 600 :]]
    source = open_source(split_bag(tmp_path / "log", parts, form))
    times = np.array([message.log_ns for message in source.messages(["/imu/data"])])
    assert len(times) == 3000
    assert (source.end_ns - source.start_ns) / S == pytest.approx(END_S, abs=0.05)
    np.testing.assert_allclose(np.diff(times) / S, 0.01, atol=0.011)
    (warning,) = source.warnings
    assert f"set back by {back_s:.1f} s, {SET_AT_S:.1f} s after the start" in warning


def test_set_back_clock_files_of_one_sensor_each_are_read_side_by_side(tmp_path: Path) -> None:
    found = records(0.0)
    parts = [[record for record in found if record[0] == topic] for topic in ("/joint_states", "/imu/data")]
    source = open_source(split_bag(tmp_path / "log", parts, "mcap"))
    assert [message.log_ns for message in source.messages(["/imu/data", "/joint_states"])] == sorted(record[2] for record in found)
    assert source.warnings == []


def test_set_back_clock_files_of_topics_one_after_the_other_are_not_moved(tmp_path: Path) -> None:
    """Sorted by topics, then split in the midst of the second one's messages."""
    found = sorted(records(0.0), key=lambda record: record[0], reverse=True)
    source = open_source(split_bag(tmp_path / "log", [found[:2500], found[2500:]], "mcap"))
    assert [message.log_ns for message in source.messages(["/imu/data", "/joint_states"])] == sorted(record[2] for record in found)
    assert source.warnings == []
