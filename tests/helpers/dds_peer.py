"""A robot on DDS, in a process of its own: plays a log's messages in real time by ROS 2's names, and receives what is published of it.

Its latched transforms are sent at once; for each number read from the standard input, the next so many seconds of the log, as soon as a
subscriber is matched that was not there before, and until the last scans are answered. At the end of the input it prints one JSON line:
what it received, how long after each scan ("latencies_s": from before this process serialised the scan until it had read the answer), and
when that was sent ("out_s": from the scan on the wire to the answer on the wire).

Its types are written out by hand in cyclonedds' own IDL and serialised by it, so that it shares nothing with what it talks to but the
wire.

python -m tests.helpers.dds_peer LOG DOMAIN
"""

import json
import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cyclonedds.core import Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

GENERAL = "<Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces><AllowMulticast>false</AllowMulticast>"
DISCOVERY = "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
XML = f"<CycloneDDS><Domain><General>{GENERAL}</General><Discovery>{DISCOVERY}</Discovery></Domain></CycloneDDS>"


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class LaserScan(IdlStruct, typename="sensor_msgs.msg.dds_.LaserScan_"):
    header: Header
    angle_min: float32
    angle_max: float32
    angle_increment: float32
    time_increment: float32
    scan_time: float32
    range_min: float32
    range_max: float32
    ranges: sequence[float32]
    intensities: sequence[float32]


@dataclass
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Imu(IdlStruct, typename="sensor_msgs.msg.dds_.Imu_"):
    header: Header
    orientation: Quaternion
    orientation_covariance: array[float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: array[float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: array[float64, 9]


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs.msg.dds_.KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticStatus_"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


PERIOD_NS = 80_000_000  # of the scans
_LAST_SCANS, _DEADLINE_S = 4, 60.0
SENT = {"/joint_states": JointState, "/scan": LaserScan, "/imu/data": Imu, "/tf_static": TFMessage}
_RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
VOLATILE = Qos(_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(50))
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))
LATCHED = Qos(_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
QUALITY = {"/scan": SENSOR, "/imu/data": SENSOR, "/tf_static": LATCHED}


def typed(kind, message):
    """A rosbags message as one of the types above, field by field."""
    values = {}
    for name, wanted in kind.__annotations__.items():
        value = getattr(message, name)
        if hasattr(value, "__msgtype__"):
            value = typed(wanted, value)
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
            value = [typed(TransformStamped, inner) for inner in value]
        values[name] = value
    return kind(**values)


def stamp(header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def scan_of(estimate_ns, sent):
    """Stamp of the scan whose sweep was halfway at ``estimate_ns``: of the last that began before."""
    before = [stamp_ns for stamp_ns in list(sent)[-200:] if 0 <= estimate_ns - stamp_ns < PERIOD_NS]
    return before[-1] if before else None


def wait(is_over) -> None:
    """Until ``is_over`` or a deadline, which only a failure reaches."""
    end = time.monotonic() + _DEADLINE_S
    while not is_over() and time.monotonic() < end:
        time.sleep(0.001)


def main(path: str, domain: int) -> None:
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = [c for c in reader.connections if c.topic in SENT]
        records = [(t, c.topic, typed(SENT[c.topic], reader.deserialize(d, c.msgtype))) for c, t, d in reader.messages(connections)]
    config = Domain(domain, XML)
    participant = DomainParticipant(domain)
    writers = {
        topic: DataWriter(participant, Topic(participant, f"rt{topic}", kind), QUALITY.get(topic, VOLATILE)) for topic, kind in SENT.items()
    }
    subscribed = {
        "/skidloc/odometry": Odometry,
        "/skidloc/odometry_predicted": Odometry,
        "/tf": TFMessage,
        "/diagnostics": DiagnosticArray,
        "/skidloc/corrections": JointState,
    }
    readers = {topic: DataReader(participant, Topic(participant, f"rt{topic}", kind), VOLATILE) for topic, kind in subscribed.items()}
    received = {topic: [] for topic in subscribed}
    scans_sent, answered, latencies, out, arrivals = {}, set(), [], [], []

    def listen() -> None:
        for topic, reader in readers.items():
            for sample in reader.take(100):
                if not isinstance(sample, subscribed[topic]):
                    continue
                if topic == "/skidloc/odometry" and (sent := scan_of(stamp(sample.header), scans_sent)) is not None:
                    before, after_ns = scans_sent[sent]
                    answered.add(sent)
                    latencies.append(time.monotonic() - before)
                    out.append((sample.sample_info.source_timestamp - after_ns) * 1e-9)
                received[topic].append(sample)
                if topic == "/skidloc/odometry":
                    arrivals.append(time.monotonic())

    for _, topic, message in records:
        if topic == "/tf_static":
            writers[topic].write(message)
    left = deque(record for record in records if record[1] != "/tf_static")
    print("up", flush=True)
    matched: set[int] = set()
    late_s = 0.0

    def has_new_subscriber() -> bool:
        return bool(set(writers["/scan"].get_matched_subscriptions()) - matched)

    for line in sys.stdin:
        wait(has_new_subscriber)
        matched.update(writers["/scan"].get_matched_subscriptions())
        print("matched", flush=True)
        begin, first = time.monotonic(), left[0][0] if left else 0
        while left and left[0][0] < first + float(line) * 1e9:
            log_ns, topic, message = left.popleft()
            while time.monotonic() < begin + (log_ns - first) * 1e-9:
                listen()
                time.sleep(0.0003)
            before = time.monotonic()
            late_s = max(late_s, before - begin - (log_ns - first) * 1e-9)
            writers[topic].write(message)
            if topic == "/scan":
                scans_sent[stamp(message.header)] = before, time.time_ns()
        due = sorted(scans_sent)[-_LAST_SCANS]  # later ones wait for the wheels' next message

        def is_answered(due=due) -> bool:
            listen()
            return max(answered, default=0) >= due

        wait(is_answered)
        end = time.monotonic() + 1.2  # diagnostics come every second
        while time.monotonic() < end:
            listen()
            time.sleep(0.001)
        print("played", flush=True)
    odometry = received["/skidloc/odometry"]
    print(
        json.dumps(
            {
                "sent_scans": len(scans_sent),
                "answered_scans": len(answered),
                "answered_stamps": sorted(answered),
                "late_s": late_s,
                "scans": [[stamp_ns, sent_s] for stamp_ns, (sent_s, _) in scans_sent.items()],
                "arrivals_s": arrivals,
                "first_predicted_s": next((o.sample_info.source_timestamp * 1e-9 for o in received["/skidloc/odometry_predicted"]), None),
                "predicted_stamps": [stamp(o.header) for o in received["/skidloc/odometry_predicted"]],
                "predicted_poses": [
                    [o.pose.pose.position.x, o.pose.pose.position.y, o.pose.pose.orientation.z]
                    for o in received["/skidloc/odometry_predicted"]
                ],
                "latencies_s": latencies,
                "out_s": out,
                "stamps": [stamp(o.header) for o in odometry],
                "poses": [[o.pose.pose.position.x, o.pose.pose.position.y, o.pose.pose.orientation.z] for o in odometry],
                "twists": [[o.twist.twist.linear.x, o.twist.twist.linear.y, o.twist.twist.angular.z] for o in odometry],
                "pose_variances": [[o.pose.covariance[0], o.pose.covariance[7], o.pose.covariance[35]] for o in odometry],
                "frames": sorted({(o.header.frame_id, o.child_frame_id) for o in odometry}),
                "tf": len(received["/tf"]),
                "corrections": [[c.name, c.position, c.effort] for c in received["/skidloc/corrections"]][-1:],
                "diagnostics": [
                    {s.name: {"level": s.level, "message": s.message, **{v.key: v.value for v in s.values}} for s in d.status}
                    for d in received["/diagnostics"]
                ],
            }
        )
    )
    del config


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
