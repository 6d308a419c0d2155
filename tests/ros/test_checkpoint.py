"""A state on disk: cut anywhere and resumed, elsewhere too, the results are the same to the last bit; no other file is taken for one."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pickle
import signal
import subprocess
import sys
import time
import types
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import CheckpointError
from localization.estimators import ESTIMATORS, ESTIMATORS_WITH_CORRECTIONS
from localization.events import StepInterval, WheelSample
from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_buffer import WheelInterval
from localization.lidar import LidarConfig
from localization.lidar.scan_matcher import ScanMatcher
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.checkpoint import CheckpointWriter, fingerprints, read_checkpoint, read_head, write_checkpoint
from localization.ros.state_serialization import deserialize, serialize, serialize_parts
from localization.sensor_checks.innovations import Bin
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.online import ROBOT, drive_events, new_core, numbers, reseal

KINDS = [(name, "skid_steer", "cg_field" if name in ESTIMATORS_WITH_CORRECTIONS else "none") for name in ESTIMATORS]
AHEAD = 300  # events after a cut that are compared: some 30 scans


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, id="-".join(kind), marks=[] if kind[0] == "graph" else [pytest.mark.extended]) for kind in KINDS]
)
def test_pipeline_cut_and_resumed_gives_the_same_bits(kind):
    events, _ = drive_events()
    cuts = {0, 1, 2, 60, *np.random.default_rng(3).integers(3, len(events), 9).tolist(), len(events)}
    pipeline, whole, states, made = new_core(*kind), [], {}, []
    for i in range(len(events) + 1):
        if i in cuts:
            states[i] = serialize(pipeline)
        made.append(len(whole))
        whole += map(numbers, pipeline.process(events[i]) if i < len(events) else pipeline.finish())
    for cut, state in states.items():
        resumed, found = deserialize(*state), []
        end = min(cut + AHEAD, len(events))
        for event in events[cut:end]:
            found += map(numbers, resumed.process(event))
        if end == len(events):
            found += map(numbers, resumed.finish())
            assert dict(resumed.estimator.parameters()) == dict(pipeline.estimator.parameters())
            assert dict(resumed.estimator.counts()) == dict(pipeline.estimator.counts())
            assert resumed.synchronizer.warnings() == pipeline.synchronizer.warnings()
            a, b = resumed.estimator.map_points(), pipeline.estimator.map_points()
            assert np.array_equal(a[np.lexsort(a.T)], b[np.lexsort(b.T)])
        expected = whole[made[cut] : made[end] if end < len(events) else len(whole)]
        assert found == expected, cut
    assert len(whole) > 200


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name != "odometry"])
def test_resumed_pipeline_with_late_mounts_gives_the_same_bits(estimator):
    """Frames are unknown to all parts of a pipeline until one moment: cut shortly before, or not."""
    events, mounts = drive_events()
    cut, met = 1000, 1100
    pipeline = Pipeline(Trial(make_model("skid_steer", ROBOT), estimator), ROBOT, {}, has_lidar=True)
    before = [numbers(e) for event in events[:cut] for e in pipeline.process(event)]
    resumed = deserialize(*serialize(pipeline))
    found = []
    for goes_on in (pipeline, resumed):
        rest = [numbers(e) for event in events[cut:met] for e in goes_on.process(event)]
        assert goes_on.add_mounts(mounts)
        assert not goes_on.add_mounts({"laser": Mount(x=9.0)})  # a frame that has its place keeps it
        rest += [numbers(e) for event in events[met : met + AHEAD] for e in goes_on.process(event)]
        found.append(rest)
        assert goes_on.synchronizer.scans.frames.problem is None
        assert "/tf_static gave the mount of the LiDAR's frame 'laser' late" in goes_on.synchronizer.warnings()[-1]
    assert found[0] == found[1]
    assert len(before) > 50


_RESUME = """
import hashlib, sys
from pathlib import Path
from localization.ros.checkpoint import read_checkpoint
from tests.helpers.online import drive_events, numbers, new_core
pipeline = read_checkpoint(Path(sys.argv[1]), {}, {}).value
events, _ = drive_events()
found = [numbers(e) for event in events[int(sys.argv[2]):] for e in pipeline.process(event)]
print(len(found), hashlib.sha256(repr(found).encode()).hexdigest())
"""


@pytest.mark.extended
def test_checkpoint_resumed_by_another_process_gives_the_same_bits(tmp_path):
    events, _ = drive_events()
    cut, pipeline = 1500, new_core("ekf")
    for event in events[:cut]:
        pipeline.process(event)
    write_checkpoint(tmp_path / "state", pipeline, {"events": cut}, {}, {})
    rest = [numbers(e) for event in events[cut:] for e in pipeline.process(event)]
    text = subprocess.run([sys.executable, "-c", _RESUME, tmp_path / "state", str(cut)], check=True, capture_output=True, text=True).stdout
    assert text.split() == [str(len(rest)), hashlib.sha256(repr(rest).encode()).hexdigest()]


def test_serialize_list_of_equal_classes_writes_columns():
    """One by one, each with names and shapes of its own, they would take seconds and megabytes of text."""
    rng = np.random.default_rng(0)
    samples = [WheelSample(i, rng.normal(size=2), rng.normal(size=2)) for i in range(20_000)]
    text, blob = serialize(samples)
    again = deserialize(text, blob)
    assert len(text) < 1000
    assert all(a.stamp_ns == b.stamp_ns for a, b in zip(again, samples, strict=True))
    assert all(np.array_equal(a.velocity, b.velocity) for a, b in zip(again, samples, strict=True))
    assert all(np.array_equal(a.position, b.position) for a, b in zip(again, samples, strict=True))
    assert again[0].position.base is None


scalars = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5)
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=12) | st.tuples(inner, inner) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
)


@given(values)
@settings(max_examples=60, deadline=None)
def test_deserialize_of_plain_values_returns_them(value):
    assert repr(deserialize(*serialize(value))) == repr(value)


def test_deserialize_of_named_tuples_keeps_their_class():
    interval = StepInterval(*range(len(StepInterval._fields)))
    kept, again = deserialize(*serialize([interval, interval]))
    assert type(kept) is StepInterval
    assert kept == interval
    assert again is kept


def test_deserialize_keeps_shared_objects_and_layouts():
    base = np.arange(24.0).reshape(4, 6).copy()
    a, b, part, turned = deserialize(*serialize([base, base, base[1:, ::2], np.asfortranarray(base)]))
    assert a is b
    np.testing.assert_array_equal(part, base[1:, ::2])
    assert turned.flags.f_contiguous
    assert not turned.flags.c_contiguous


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_pipeline_holds_contiguous_arrays_alone(estimator):
    """A view of another array would be resumed as one of its own, and linear algebra rounds by layout."""
    found, seen, left = [], set(), [new_core(estimator)]
    events, _ = drive_events()
    for event in events[:1500]:
        left[0].process(event)
    while left:
        value = left.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            found += [value.shape] if not (value.flags.c_contiguous or value.flags.f_contiguous) else []
        elif isinstance(value, dict):
            left += value.values()
        elif isinstance(value, list | tuple | deque):
            left += value
        elif type(value).__module__.startswith(("localization.", "motion_models.")):
            left += vars(value).values() if hasattr(value, "__dict__") else []
    assert found == []
    assert len(seen) > 100


@pytest.mark.parametrize("strange", [print, object(), {1, 2}, np.array([object()]), sys])
def test_serialize_of_a_foreign_object_is_refused_by_name(strange):
    with pytest.raises(CheckpointError, match="holds a"):
        serialize([strange])


@pytest.fixture
def state(tmp_path):
    path = tmp_path / "state"
    write_checkpoint(path, new_core("ekf"), {"events": 0}, made_by(), {})
    return path


def made_by(robot=ROBOT, model="skid_steer", config=None):
    return fingerprints(robot=robot, model=make_model(model, robot), estimator="ekf", configuration=config or ReplayConfig())


def test_read_checkpoint_with_any_damage_is_refused(state):
    content = bytearray(state.read_bytes())
    rng = np.random.default_rng(1)
    for at in [0, 8, 20, 90, 200, len(content) - 1, *rng.integers(0, len(content), 30)]:
        damaged = bytearray(content)
        damaged[at] ^= 0x20
        state.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"damaged|no state of an estimator|another version"):
            read_checkpoint(state, made_by(), {})
    for length in (0, 5, 16, 50, len(content) // 2, len(content) - 1):
        state.write_bytes(content[:length])
        with pytest.raises(CheckpointError, match=r"damaged|no state of an estimator"):
            read_checkpoint(state, made_by(), {})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("events", -1),
        ("events", "x"),
        ("events", 10**30),
        ("records", -5),
        ("records", 1.5),
        ("made_by", None),
        ("made_by", []),
        ("state_bytes", -1),
        ("state_bytes", 10**9),
        ("state_bytes", None),
        ("stamp_ns", "now"),
        ("stamp_ns", 10**400),
        ("topics", "/scan"),
        ("topics", [1]),
    ],
)
def test_read_checkpoint_with_a_malformed_head_is_refused(state, name, value):
    reseal(state, name, value)
    for read in (read_head, lambda path: read_checkpoint(path, made_by(), {})):
        with pytest.raises(CheckpointError, match="no readable head"):
            read(state)


def test_read_checkpoint_of_a_foreign_file_runs_no_code(tmp_path):
    path, trap = tmp_path / "x", tmp_path / "trap"

    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(trap),)

    for content in (pickle.dumps(Trap()), b"PK\3\4", b"", b"{}", os.urandom(1000)):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="no state of an estimator"):
            read_checkpoint(path, {}, {})
    assert not trap.exists()
    with pytest.raises(CheckpointError, match="No such file"):
        read_checkpoint(tmp_path / "absent", {}, {})
    path.write_bytes(b"skidloc state 9\nabc\n")
    with pytest.raises(CheckpointError, match="another version of its format"):
        read_head(path)


@pytest.mark.parametrize(
    "kind", [["c", "os", "system", {}], ["c", "subprocess", "Popen", {}], ["c", "localization.pipeline", "Nobody", {}]]
)
def test_deserialize_of_a_foreign_class_is_refused(kind):
    text = json.dumps({"root": ["o", 0], "objects": [kind], "arrays": []}).encode()
    with pytest.raises(CheckpointError, match="does not have"):
        deserialize(text, b"")
    packed = ["p", "objects", kind[1], kind[2], ["a"], ["int", 0]]
    text = json.dumps({"root": ["o", 0], "objects": [packed], "arrays": [["<i8", [1], "C", 0]]}).encode()
    with pytest.raises(CheckpointError, match="does not have"):
        deserialize(text, bytes(8))


def test_serialize_of_named_tuples_writes_columns():
    values = [WheelInterval(i, 0.1 * i, 0.2 * i, 0.0, 0.0, i % 2 == 0) for i in range(1000)]
    text, blob = serialize(values)
    assert len(text) < 1000
    found = deserialize(text, blob)
    assert found == values
    assert {type(value) for value in found} == {WheelInterval}


def test_serialize_of_rows_within_rows_writes_columns():
    """Named tuples that hold tuples and arrays of different lengths; of an array in two places there is one afterwards."""
    poses = [np.arange(float(i)) for i in range(40)]
    values = [Bin(0.5 * i, 0.1, 0.2, 0.3, (0.1 * i, 1.0, 2.0, 3.0), 0.01, poses[i % 40]) for i in range(200)]
    text, blob = serialize(values)
    assert text.count(b"Bin") == 1
    assert len(blob) < 200 * 10 * 8 + sum(pose.nbytes for pose in poses)
    found = deserialize(text, blob)
    assert [value[:6] for value in found] == [value[:6] for value in values]
    assert {type(value) for value in found} == {Bin}
    assert all(np.array_equal(a.poses, b.poses) for a, b in zip(found, values, strict=True))
    assert found[0].poses is found[40].poses


@given(st.binary(max_size=60), st.binary(max_size=20))
def test_deserialize_of_random_bytes_is_refused(text, blob):
    with pytest.raises(CheckpointError):
        deserialize(text, blob)


def test_read_checkpoint_of_another_robot_or_model_is_refused(state):
    assert isinstance(read_checkpoint(state, made_by(), {}).value, Pipeline)
    heavier = dataclasses.replace(ROBOT, geometry=dataclasses.replace(ROBOT.geometry, mass_kg=120.0))
    for other, error in [
        (made_by(load_robot("husky_a200")), r"another .*robot \('vaultbot' \w+ then, 'husky_a200' \w+ now\)"),
        (made_by(heavier), "another robot"),
        (made_by(model="diff_drive"), "another model"),
        (made_by(config=ReplayConfig(step=StepConfig(wait_s=0.2))), "another configuration"),
        ({**made_by(), "version of numpy": "1.0"}, "another version of numpy"),
    ]:
        with pytest.raises(CheckpointError, match=error):
            read_checkpoint(state, other, {})
    moved = dataclasses.replace(ROBOT, folder=state.parent)
    assert isinstance(read_checkpoint(state, made_by(moved), {}).value, Pipeline)


def test_fingerprints_of_a_mount_that_was_used_are_those_of_a_new_one():
    """A process that asked for its rotation resumes what one wrote that had not."""
    used = Mount(x=0.4, yaw=0.1)
    assert np.isfinite(used.rotation).all()
    assert fingerprints(mount=used) == fingerprints(mount=Mount(x=0.4, yaw=0.1))
    assert fingerprints(mount=used) != fingerprints(mount=Mount(x=0.4, yaw=0.2))


def test_write_checkpoint_interrupted_keeps_the_old_state(state, monkeypatch):
    before = state.read_bytes()

    def full_disk(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(CheckpointError, match="No space left"):
        write_checkpoint(state, [1], {}, {}, {})
    assert state.read_bytes() == before
    assert [path.name for path in state.parent.iterdir()] == ["state"]


def test_checkpoint_writer_on_a_busy_machine_is_as_often_due(tmp_path, monkeypatch):
    """Where a state takes half a second by the clock, but hardly any CPU."""
    clock = types.SimpleNamespace(now_s=0.0, monotonic=lambda: clock.now_s, thread_time=lambda: 0.0)
    monkeypatch.setattr("localization.ros.checkpoint.time", clock)
    checkpoints = CheckpointWriter(tmp_path / "state", {}, {}, every_s=0.75)

    def serialize_slowly(value, shared):
        clock.now_s += 0.5
        return serialize_parts(value, shared)

    monkeypatch.setattr("localization.ros.checkpoint.serialize_parts", serialize_slowly)
    checkpoints.write([1.5], {})
    checkpoints.wait()
    clock.now_s = 0.76
    assert checkpoints.is_due()
    checkpoints.close()


def test_checkpoint_writer_keeps_its_period_and_reports_a_full_disk(tmp_path, monkeypatch):
    checkpoints = CheckpointWriter(tmp_path / "state", {}, {}, every_s=30.0)
    assert checkpoints.is_due()
    checkpoints.write([1.5], {"events": 7})
    assert not checkpoints.is_due()
    checkpoints.wait()
    assert not checkpoints.is_due()
    assert read_checkpoint(tmp_path / "state", {}, {}).value == [1.5]
    assert read_head(tmp_path / "state")["events"] == 7

    def full_disk(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    checkpoints.write([2.5], {})
    with pytest.raises(CheckpointError, match="No space left"):
        checkpoints.close()
    assert read_checkpoint(tmp_path / "state", {}, {}).value == [1.5]


def test_serialized_submap_is_key_scans_and_matches_bit_by_bit():
    """Voxels, their surfaces and the image of the search follow from the points."""
    rng, matcher = np.random.default_rng(0), ScanMatcher(LidarConfig(), 0.1)
    angles = np.linspace(-3.1, 3.1, 400)
    room = np.column_stack([np.clip(9.0 * np.cos(angles), -4.0, 5.0), np.clip(9.0 * np.sin(angles), -3.0, 2.0)])
    for key in range(3):
        matcher.insert_key_scan(np.array([0.01 * key, 0.0, 0.0]), room + 0.01 * rng.normal(size=room.shape))
    prior, narrow, wide = np.array([0.02, -0.01, 0.005]), np.diag([1e-3, 1e-3, 1e-4]), np.diag([0.2, 0.2, 0.1])
    matcher.match(room, prior, narrow)  # fills surfaces
    matcher.match(room, prior, wide)  # draws the image
    text, blob = serialize(matcher)
    assert len(text) + len(blob) < 16 * 3 * len(room) + 2000
    again = deserialize(text, blob)
    for cov in (narrow, wide):
        one, other = (m.match(room, prior, cov) for m in (matcher, again))
        assert one is not None
        assert all(np.array_equal(vars(one)[name], vars(other)[name]) for name in vars(one))
    assert deserialize(*serialize(ScanMatcher(LidarConfig(), 0.1))).submap.points().shape == (0, 2)


def test_serialize_does_not_write_shared_objects():
    model = make_model("skid_steer", ROBOT)
    pair = Trial(model, "ekf")
    assert deserialize(*serialize([pair, model], {"model": model}), {"model": model})[1] is model


@pytest.mark.extended
def test_checkpoint_killed_at_any_moment_is_whole(tmp_path):
    """kill -9, twenty times, while states of a megabyte are written one after another."""
    path, rng = tmp_path / "state", np.random.default_rng(0)
    write_checkpoint(path, [0], {"events": 0}, {}, {})
    for _ in range(20):
        events = read_head(path)["events"]
        child = os.fork()
        if child == 0:
            for count in range(events + 1, events + 10**6):
                write_checkpoint(path, np.full(2**17, count), {"events": count}, {}, {})
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = read_checkpoint(path, {}, {})
        assert np.all(np.asarray(found.value) == found.head["events"])
    assert read_head(path)["events"] > 0
