"""ROS 2 without ROS: a robot in another process, whose messages are its own, over DDS."""

from __future__ import annotations

import contextlib
import functools
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from localization.errors import TransportError
from localization.logs import open_log
from localization.pipeline import Trial, replay
from localization.ros.transports.dds_settings import choose_interface, configuration, default_domain
from localization.trajectory import read_tum
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, drive_log

pytest.importorskip("cyclonedds", reason="the extra 'ros2' (cyclonedds) is not installed")
pytestmark = pytest.mark.xdist_group("online")
S = 1_000_000_000
DOMAIN = 100 + os.getpid() % 100  # not that of another run of these tests


def start_node(*arguments):
    command = [sys.executable, "-m", "localization.cli", "online", "--robot", "vaultbot", "--door", "dds"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "ROS_DOMAIN_ID": str(DOMAIN)}
    return subprocess.Popen([*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


class Peer:
    """The robot: `tests.helpers.dds_peer`."""

    def __init__(self):
        command = [sys.executable, "-m", "tests.helpers.dds_peer", str(drive_log()), str(DOMAIN)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
        assert self.process.stdout.readline() == "up\n"

    def play(self, seconds):
        self.begin(seconds)
        self.wait()

    def begin(self, seconds):
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()

    def wait(self):
        assert self.process.stdout.readline() == "played\n"

    def heard(self):
        return json.loads(self.process.communicate(timeout=30)[0])


@functools.cache
def replayed():
    log = open_log(drive_log(), ROBOT)
    return replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "ekf")], ROBOT, log.mounts, True)[0]


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.communicate(timeout=30)[0]
    process.kill()
    pytest.fail(f"does not end: {process.communicate()[0]}")


def addresses_listened_to(pid):
    """Local UDP addresses of a process, and the device each is bound to, as the kernel has them."""
    said = subprocess.run(["ss", "-ulnp"], capture_output=True, text=True, check=True).stdout
    return [line.split()[3] for line in said.splitlines() if f"pid={pid}," in line]


def test_a_robot_in_another_process_is_followed_killed_and_followed_on(tmp_path):
    """The robot (its latched transforms first) is there before the estimator, which is killed on the way and started again."""
    files = ("--state", tmp_path / "state", "--out", tmp_path / "live.tum", "--node.wait-s", "1")
    peer = Peer()
    node = start_node(*files)
    waiting = node.stdout.readline()
    peer.play(8.0)
    listening = addresses_listened_to(node.pid)
    node.kill()
    said = waiting + node.communicate()[0]
    assert (tmp_path / "state").exists(), said
    node = start_node(*files)
    waiting = node.stdout.readline()
    peer.play(99.0)
    said = waiting + ended(node)
    heard = peer.heard()
    assert "resumed from" in said, said
    assert node.returncode == 0

    # nobody else is listened to
    assert listening
    assert all("%lo:" in address or address.startswith("127.0.0.1") for address in listening)

    run = replayed().trajectory
    by_stamp = dict(zip(run.stamps_ns.tolist(), run.poses, strict=True))
    stamps = heard["stamps"]
    assert len(stamps) > 0.8 * heard["sent_scans"]
    shared = [i for i, stamp in enumerate(stamps) if stamp in by_stamp]
    assert len(shared) > 0.95 * len(stamps)  # they bear the scans' stamps, but where one was lost
    assert heard["frames"] == [["odom", "base_link"]]
    assert heard["tf"] >= 0.9 * len(stamps)
    # what it says of the motion between its first and its last estimate, whatever it missed at its start, is what a replay says
    poses = np.array([[x, y, 2.0 * np.arcsin(z)] for x, y, z in heard["poses"]])
    poses = poses[shared]
    there = np.array([by_stamp[stamps[i]] for i in (shared[0], shared[-1])])
    distance = np.hypot(*(poses[-1] - poses[0])[:2])
    assert distance == pytest.approx(np.hypot(*(there[1] - there[0])[:2]), abs=0.1)
    assert np.hypot(*poses[-1][:2] - there[1][:2]) < 0.1  # not from the origin again
    assert (np.array(heard["pose_variances"])[5:] > 0.0).all()
    turning = [t for t in heard["twists"] if abs(t[2]) > 0.3]
    assert np.median([abs(t[1] / t[2]) for t in turning]) > 0.003  # true vy
    (names, means, sigmas) = heard["corrections"][0]
    assert "k_0" in names
    assert len(names) == len(means) == len(sigmas)
    last = heard["diagnostics"][-2]
    assert {"skidloc: estimate", "skidloc: lidar", "skidloc: wheels", "skidloc: files", "skidloc: messages", "skidloc: transforms"} == set(
        last
    )
    assert float(last["skidloc: lidar"]["degeneracy"]) > 0.1
    assert float(last["skidloc: lidar"]["nis_mean"]) < 8.0
    # and the whole way is in one file
    live = read_tum(tmp_path / "live.tum")
    assert (np.diff(live.stamps_ns) > 0).all()
    assert len(live) >= 0.9 * len(stamps)


def test_node_that_was_stopped_for_5_s_is_back_within_1_s(tmp_path):
    """SIGSTOP: 250 messages of wheels and IMU each come for queues of 200, and scans overflow the socket's buffer."""
    state = tmp_path / "state"
    peer, node = Peer(), start_node("--state", state, "--node.wait-s", "1")
    node.stdout.readline()
    peer.begin(15.0)
    time.sleep(7.0)
    node.send_signal(signal.SIGSTOP)
    time.sleep(5.0)
    node.send_signal(signal.SIGCONT)
    resumed_s = time.monotonic()
    peer.wait()
    text = ended(node)
    assert node.returncode == 0, text
    assert "jump of the clock" not in text
    again = start_node("--state", state, "--node.wait-s", "1")
    again.stdout.readline()
    peer.play(99.0)
    text = ended(again)
    assert "resumed from" in text
    assert again.returncode == 0, text
    heard = peer.heard()
    stamps, arrivals = np.array(heard["stamps"]), np.array(heard["arrivals_s"])
    sent = dict(heard["scans"])
    after = [i for i in range(len(stamps)) if arrivals[i] > resumed_s]
    current = next(i for i in after if arrivals[i] - sent[max(stamp for stamp in sent if stamp <= stamps[i])] < 0.2)
    assert arrivals[after[0]] - resumed_s < 1.0
    assert arrivals[current] - resumed_s < 2.5  # half the pause: 0.7 s on an idle machine
    run = replayed().trajectory
    by_stamp = dict(zip(run.stamps_ns.tolist(), run.poses, strict=True))
    before = next(i for i in reversed(range(len(stamps))) if arrivals[i] < resumed_s - 5.0 and stamps[i] in by_stamp)
    poses = np.array([[x, y, 2.0 * np.arcsin(z)] for x, y, z in heard["poses"]])
    sigmas = np.sqrt(heard["pose_variances"])
    for i in (next(i for i in after if i >= current and stamps[i] in by_stamp), max(i for i in after if stamps[i] in by_stamp)):
        moved, expected = (se2.between(a, b) for a, b in ((poses[before], poses[i]), (by_stamp[stamps[before]], by_stamp[stamps[i]])))
        print(np.abs(se2.between(expected, moved)), sigmas[i], arrivals[current] - resumed_s)
        assert (np.abs(se2.between(expected, moved)) < 5.0 * sigmas[i]).all()


def test_nobody_there_is_told_and_interrupted_without_a_word_too_many(tmp_path):
    node = start_node("--node.wait-s", "0.5")
    line = node.stdout.readline()
    said = line + ended(node, signal.SIGTERM)
    assert "nothing comes on /joint_states (sensor_msgs/JointState)" in " ".join(said.split())
    assert node.returncode == 130
    assert "Traceback" not in said


def test_who_hears_nobody_is_told_where_it_listens(monkeypatch, capsys):
    """And how to hear the others, in the domain of ROS's environment."""
    node = start_node("--node.wait-s", "0.5")
    said = " ".join((node.stdout.readline() + ended(node)).split())
    assert f"Nobody publishes anything in domain {DOMAIN} on interface lo." in said
    assert "--interface default" in said
    for bad in ("231", "-1", "robot", "1.5"):
        monkeypatch.setenv("ROS_DOMAIN_ID", bad)
        assert main(["online", "--robot", "vaultbot", "--door", "dds"]) == 2
        assert f"ROS_DOMAIN_ID is '{bad}'; ROS 2's domains are the numbers 0 to 230." in capsys.readouterr().err
    for domain in (0, 230):
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        assert default_domain() == domain
    for nothing in (lambda: monkeypatch.setenv("ROS_DOMAIN_ID", ""), lambda: monkeypatch.delenv("ROS_DOMAIN_ID")):
        nothing()
        assert default_domain() == 0


def test_another_type_is_refused_by_what_the_robot_says_of_itself(capsys):
    """A robot whose /scan is a cloud: DDS itself would only be silent."""
    code = (
        "import sys, time\n"
        "from tests.helpers.dds_peer import *\n"
        "d = Domain(int(sys.argv[1]), XML); p = DomainParticipant(int(sys.argv[1]))\n"
        "w = [DataWriter(p, Topic(p, n, k), SENSOR) for n, k in (('rt/scan', Imu), ('rt/joint_states', JointState))]\n"
        "print('up', flush=True); time.sleep(60)\n"
    )
    peer = subprocess.Popen([sys.executable, "-c", code, str(DOMAIN)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
    try:
        assert peer.stdout.readline() == "up\n"
        assert main(["online", "--robot", "vaultbot", "--door", "dds", "--domain", str(DOMAIN), "--node.wait-s", "20"]) == 2
        assert "'/scan' carries sensor_msgs/Imu, not sensor_msgs/LaserScan." in " ".join(capsys.readouterr().err.split())
    finally:
        peer.kill()
        peer.wait()


def test_topics_that_are_not_kept_are_heard_no_more():
    """And what is heard comes in the order in which it was sent."""
    with chatter("abc") as here:
        here.restrict(["/c", "/a"])
        here.take(0.1)
        time.sleep(0.5)
        found = here.take(1.0)
        assert {received.topic for received in found} == {"/a", "/c"}
        said = "".join(received.topic[1] for received in found)
        assert said.strip("ac") == ""
        assert said.replace("ac", "") in ("", "a", "c", "ca")  # in turn, not one topic's after the other's
        assert all(received.data[8:9].decode() == received.topic[1] for received in found)


def test_messages_that_waited_came_when_they_were_sent():
    """Two seconds without a look, of which the last one is kept."""
    with chatter("a") as here:
        here.restrict(["/a"])
        here.take(1.0)
        looked = time.monotonic_ns()
        time.sleep(2.0)
        came = [received.received_ns for received in here.take(1.0)]
        assert len(came) == 200
        assert (np.diff(came) > 0).all()
        assert came[0] > looked + 0.3 * S
        assert came[-1] - came[0] > 0.99 * S
        assert came[-1] <= time.monotonic_ns()


def test_times_of_receiving_lie_between_two_looks():
    receive_times = importlib.import_module("localization.ros.transports.dds").receive_times
    assert receive_times([], 0, 100) == []
    assert receive_times([7], 0, 100) == [100]
    assert receive_times([10, 30, 50], 0, 100) == [60, 80, 100]
    assert receive_times([50, 10, 30], 60, 120) == [120, 80, 100]  # whatever their order
    assert receive_times([1000, 3000, 5000], 60, 120) == [80, 100, 120]  # the sender's clock is another one
    assert receive_times([5, 5, 5], 60, 120) == [120, 120, 120]  # sent in a burst


def test_what_had_to_wait_for_us_came_when_it_was_sent():
    """A sender's clock, 5 s behind ours, whose messages take 1 ms or more; then we do not look for 12 s, and find the oldest first."""
    clock, ms = importlib.import_module("localization.ros.transports.dds").SenderClock(), S // 1000
    ours = [100 * S + i * 20 * ms for i in range(50)]
    for i, now in enumerate(ours):
        came = clock.receive_time_ns(now - 5 * S - (1 + i % 3) * ms, now - 15 * ms, now)
        assert now - 3 * ms <= came <= now
    begin = ours[-1]
    assert clock.receive_time_ns(begin - S, begin, begin + 12 * S) == pytest.approx(begin + 4 * S, abs=3 * ms)
    # 40 ms on the way, and looked for all the time
    assert clock.receive_time_ns(begin + 7 * S, begin + 12.03 * S, begin + 12.04 * S) == begin + 12.04 * S
    # it is set: forward, and back
    for shift in (3600 * S, -3600 * S):
        now = begin + 20 * S
        assert [clock.receive_time_ns(now - 5 * S + shift + at, now + at - 20 * ms, now + at) - now for at in (0, S, 2 * S)] == [
            0,
            S,
            2 * S,
        ]


def test_patience_ends_where_something_urgent_comes():
    """Twenty messages of /a to one of /b; without patience each is heard when it comes."""
    with chatter("a" * 20 + "b") as here:
        here.restrict(["/a", "/b"], ["/b"])
        here.take(1.0, 20.0)
        found = here.take(1.0, 20.0)
        assert len(found) < 100  # it did not wait for 20 s, after which the last 200 would be there
        assert "/b" in {received.topic for received in found}
        alone = [here.take(1.0) for _ in range(30)]
        assert any({received.topic for received in found} == {"/a"} for found in alone)


@pytest.mark.parametrize(
    ("interface", "environment", "chosen"),
    [
        (None, {}, "lo"),
        ("lo", {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "lo"),
        ("localhost", {}, "lo"),
        ("127.0.0.1", {}, "lo"),
        ("default", {}, "default"),
        ("192.0.2.7", {"ROS_LOCALHOST_ONLY": "1"}, "192.0.2.7"),
        *((i, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, "lo") for i in (None, "default")),
        *((i, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"}, "default") for i in (None, "default")),
        (None, {"ROS_LOCALHOST_ONLY": "0"}, "lo"),
        ("default", {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "lo"),
    ],
)
def test_choose_interface_follows_the_option_then_ros_variables(interface, environment, chosen):
    assert choose_interface(interface, environment) == chosen


@pytest.mark.parametrize(
    ("interface", "environment", "error"),
    [
        ("etho", {}, "there are lo"),
        ("localhots", {}, "Did you mean 'localhost'?"),
        (None, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOSTS"}, "Did you mean LOCALHOST?"),
        ("default", {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "no topic can be discovered"),
    ],
)
def test_choose_interface_refuses_what_does_not_exist(interface, environment, error):
    with pytest.raises(TransportError, match=re.escape(error)):
        choose_interface(interface, environment)


def test_configuration_of_default_ends_with_the_users():
    environment = {"CYCLONEDDS_URI": "file:///etc/cyclone.xml", "ROS_STATIC_PEERS": "192.0.2.9; robot.local"}
    fragments = configuration("default", environment).split(",")
    assert fragments[1:] == ["file:///etc/cyclone.xml"]
    for peer in ("localhost", "192.0.2.9", "robot.local"):
        assert f'<Peer address="{peer}"/>' in fragments[0]
    for interface in ("default", "lo", "192.0.2.7"):
        assert "<IgnoreTypeInformation>1.15</IgnoreTypeInformation>" in configuration(interface, environment)
    assert "cyclone.xml" not in configuration("lo", environment)


def test_publishers_of_a_participant_that_left_are_gone():
    """A sample of an instance without a publisher holds its key alone, no names."""
    with chatter("a") as here:
        assert "/a" in here.publishers()
        with chatter("b", here):
            assert {"/a", "/b"} <= set(here.publishers())
        end = time.monotonic() + 15.0  # it was killed: its lease of 10 s has to end
        while "/b" in here.publishers():
            assert time.monotonic() < end
            time.sleep(0.1)
        assert "/a" in here.publishers()


def test_node_and_type_hashes_are_published_as_by_ros2():
    """Received by a peer whose types are written out by hand."""
    here = importlib.import_module("localization.ros.transports.dds").DdsTransport(DOMAIN, name="rover", namespace="/team")
    here.subscribe("/scan", "sensor_msgs/msg/LaserScan", is_latched=False)
    here.advertise("/odometry", "nav_msgs/msg/Odometry")
    code = (
        "import json, sys, time\n"
        "from cyclonedds.builtin import *\n"
        "from tests.helpers.dds_peer import *\n"
        "d = Domain(int(sys.argv[1]), XML); p = DomainParticipant(int(sys.argv[1]))\n"
        "r = DataReader(p, Topic(p, 'ros_discovery_info', ParticipantEntitiesInfo), LATCHED)\n"
        "b = [BuiltinDataReader(p, t) for t in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription, BuiltinTopicDcpsParticipant)]\n"
        "time.sleep(3)\n"
        "info = [s for s in r.take(9)][-1]; node = info.node_entities_info_seq[0]\n"
        "def data(s): return (s.qos[Policy.Userdata] or Policy.Userdata(b'')).data.decode()\n"
        "ends = [(s.topic_name, data(s), list(s.key.bytes)) for q in b[:2] for s in q.read(99)]\n"
        "said = [data(s) for s in b[2].read(9)]\n"
        "gids = [[list(g.data) for g in seq] for seq in (node.writer_gid_seq, node.reader_gid_seq)]\n"
        "print(json.dumps([node.node_namespace, node.node_name, gids, ends, said]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(DOMAIN)], capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=60
    )
    here.close()
    assert done.returncode == 0, done.stderr
    namespace, name, (writers, readers), ends, participants = json.loads(done.stdout)
    assert (namespace, name) == ("/team", "rover")
    found = {topic: (data, gid) for topic, data, gid in ends if topic.startswith("rt/")}
    # ROS 2's own hashes, as its message packages ship them
    assert found["rt/scan"] == ("typehash=RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828;", readers[0])
    assert found["rt/odometry"] == ("typehash=RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0;", writers[0])
    assert "enclave=/;" in participants


@contextlib.contextmanager
def chatter(names, transport=None):
    """A transport that receives the topics of these names from another process, one message every 5 ms, each with its name."""
    here = transport or importlib.import_module("localization.ros.transports.dds").DdsTransport(DOMAIN)
    code = (
        "import sys, time\n"
        "from localization.ros.transports.dds import DdsTransport\n"
        "t = DdsTransport(int(sys.argv[1]))\n"
        "for name in set(sys.argv[2]): t.advertise('/' + name, 'std_msgs/msg/String')\n"
        "while True:\n"
        "    for name in sys.argv[2]:\n"
        "        t.publish('/' + name, b'\\0\\1\\0\\0\\2\\0\\0\\0' + name.encode() + b'\\0')\n"
        "        time.sleep(0.005)\n"
    )
    for name in set(names):
        here.subscribe(f"/{name}", "std_msgs/msg/String", is_latched=False)
    peer = subprocess.Popen([sys.executable, "-c", code, str(DOMAIN), names], cwd=Path(__file__).parents[2])
    try:
        wanted, end = {f"/{name}" for name in names}, time.monotonic() + 30.0
        while wanted and time.monotonic() < end:
            wanted -= {received.topic for received in here.take(0.2)}
        assert not wanted
        yield here
    finally:
        peer.kill()
        peer.wait()
        if transport is None:
            here.close()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["--domain", "999"], "the domain is 999"), (["--interface", "no_such_device"], "interface 'no_such_device'")],
)
def test_bad_domains_and_interfaces_are_explained(arguments, said, capsys):
    assert main(["online", "--robot", "vaultbot", "--door", "dds", *arguments]) == 2
    assert said in capsys.readouterr().err
