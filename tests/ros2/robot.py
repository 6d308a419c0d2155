"""A robot on rclpy, in a process of its own: plays recorded messages in real time and records what is published of it.

python robot.py MESSAGES, where MESSAGES is a pickle of (log time [ns], topic, type, bytes). Commands come on the standard input, one
a line, and each is answered by one line: `play SECONDS`, `spin SECONDS`, `report` (JSON), `cloud BYTES COUNT` (PointCloud2 at 10 Hz),
`payload KG`, `reset`, `set_pose X Y`, `initialpose X Y YAW`, `text TOPIC TEXT` (std_msgs/String), `call SERVICE` (std_srvs/Empty),
`clear` (what was received so far), `drive SECONDS` (the same messages over and over, stamped by the
clock on the wall).
It imports nothing of this project.
"""

import importlib
import json
import math
import pickle
import struct
import sys
import time
from array import array
from collections import deque

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Empty, String
from std_srvs.srv import Empty as EmptyService
from tf2_msgs.msg import TFMessage

PERIOD_NS = 80_000_000  # of the scans
MATCHED_S = 0.5  # until the subscription knows of the publisher, too: what is sent before is lost to it (1 of 8 messages)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
QUALITY = {"/scan": qos_profile_sensor_data, "/imu/data": qos_profile_sensor_data, "/tf_static": LATCHED}


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Robot:
    def __init__(self, messages):
        rclpy.init(args=[])
        self.node = rclpy.create_node("robot")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.odometry, self.predicted, self.statuses, self.tf = [], [], {}, []
        self.sent, self.latencies, self.first_s = {}, {}, None
        self.begin = time.monotonic()
        for topic, kind in (("/skidloc/odometry", Odometry), ("/tf", TFMessage), ("/diagnostics", DiagnosticArray)):
            self.node.create_subscription(kind, topic, getattr(self, f"on_{kind.__name__}"), 50)
        self.grids = []
        self.node.create_subscription(OccupancyGrid, "/skidloc/map", self.grids.append, LATCHED)
        self.node.create_subscription(Odometry, "/skidloc/odometry_predicted", lambda m: self.predicted.append(stamp(m)), 50)
        self.initial_pose = self.node.create_publisher(PoseWithCovarianceStamped, "/set_pose", 1)
        self.payloads = self.node.create_publisher(InertiaStamped, "/skidloc/payload", 1)
        self.resets = self.node.create_publisher(Empty, "/skidloc/reset", 1)
        kinds = {topic: kind for _, topic, kind, _ in messages}
        self.publishers = {topic: self.publisher(topic, kind) for topic, kind in kinds.items()}
        for _, topic, _, data in messages:
            if topic == "/tf_static":
                self.publishers[topic].publish(data)
        self.drive_messages = [message for message in messages if message[1] != "/tf_static"]
        self.left = deque(self.drive_messages)
        self.create_echo_subscription()

    def publisher(self, topic, kind):
        package, _, name = kind.split("/")
        message = getattr(importlib.import_module(f"{package}.msg"), name)
        return self.node.create_publisher(message, topic, QUALITY.get(topic, 50))

    def on_Odometry(self, message):
        now = time.monotonic()
        self.first_s = now - self.begin if self.first_s is None else self.first_s
        if (sent := self.scan_of(stamp(message))) is not None:
            self.latencies[sent] = now - self.sent[sent]
        self.odometry.append(message)

    def scan_of(self, estimate_ns):
        """Stamp of the scan whose sweep was halfway at ``estimate_ns``: of the last that began before."""
        before = [sent for sent in list(self.sent)[-200:] if 0 <= estimate_ns - sent < PERIOD_NS]
        return before[-1] if before else None

    def on_TFMessage(self, message):
        self.tf += [(t.header.frame_id, t.child_frame_id) for t in message.transforms]

    def on_DiagnosticArray(self, message):
        self.statuses |= {s.name: {"level": s.level[0], "message": s.message} for s in message.status}

    def set_pose(self, x, y):
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "odom"
        message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.orientation.w = x, y, 1.0
        self.initial_pose.publish(message)
        self.spin(0.5)

    def initialpose(self, x, y, yaw):
        """As RViz sends it."""
        message = PoseWithCovarianceStamped()
        message.header.frame_id, pose = "map", message.pose.pose
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        message.pose.covariance[0] = message.pose.covariance[7] = 0.25
        message.pose.covariance[35] = 0.07
        self.send("/initialpose", message)

    def text(self, topic, data):
        self.send(topic, String(data=data))

    def send(self, topic, message):
        publisher = self.node.create_publisher(type(message), topic, 1)
        end = time.monotonic() + 20.0
        while not publisher.get_subscription_count() and time.monotonic() < end:
            self.spin(0.1)
        self.spin(MATCHED_S)
        publisher.publish(message)
        self.spin(1.0)
        self.node.destroy_publisher(publisher)

    def call(self, service):
        client = self.node.create_client(EmptyService, service)
        assert client.wait_for_service(timeout_sec=30.0), f"no service {service}"
        future = client.call_async(EmptyService.Request())
        end = time.monotonic() + 30.0
        while not future.done() and time.monotonic() < end:
            self.spin(0.1)
        assert future.done(), f"{service} does not answer"

    def payload(self, mass):
        """Command the payload on the body, by its topic."""
        message = InertiaStamped()
        message.header.frame_id, message.inertia.m = "base_link", mass
        self.payloads.publish(message)
        self.spin(0.5)

    def reset(self):
        """Command a reset, by its topic."""
        self.resets.publish(Empty())
        self.spin(0.5)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def create_echo_subscription(self):
        def on_echo(message):
            self.echo_latencies.append(time.monotonic() - self.sent.get(stamp(message), time.monotonic()))

        self.echo_latencies = []
        self.node.create_subscription(Odometry, "/echo/odometry", on_echo, 50)

    def clear(self):
        self.odometry.clear()
        self.predicted.clear()
        self.sent.clear()
        self.latencies.clear()
        self.echo_latencies.clear()

    def drive(self, seconds):
        """A message is sent as long after the first of the round as it was recorded."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if not self.left or not hasattr(self, "round_s"):
                self.left = deque(self.drive_messages)
                self.round_s, self.round_ns, self.first_ns = time.monotonic(), time.time_ns(), self.left[0][0]
            if self.round_s + (self.left[0][0] - self.first_ns) * 1e-9 < time.monotonic() - 0.5:  # was not driven for a while
                pause = time.monotonic() - self.round_s - (self.left[0][0] - self.first_ns) * 1e-9
                self.round_s, self.round_ns = self.round_s + pause, self.round_ns + int(pause * 1e9)
            at, topic, _, data = self.left.popleft()
            self.spin(self.round_s + (at - self.first_ns) * 1e-9 - time.monotonic())
            sec, nanosec = struct.unpack_from("<II", data, 4)
            stamp_ns = sec * 10**9 + nanosec - self.first_ns + self.round_ns
            if topic == "/scan":
                self.sent[stamp_ns] = time.monotonic()
            data = data[:4] + struct.pack("<II", stamp_ns // 10**9, stamp_ns % 10**9) + data[12:]
            self.publishers[topic].publish(data)

    def play(self, seconds):
        begin, first = time.monotonic(), self.left[0][0] if self.left else 0
        while self.left and self.left[0][0] < first + seconds * 1e9:
            at, topic, _, data = self.left.popleft()
            self.spin(begin + (at - first) * 1e-9 - time.monotonic())
            if topic == "/scan":
                sec, nanosec = memoryview(data)[4:12].cast("I")  # the header's stamp comes first
                self.sent[sec * 10**9 + nanosec] = time.monotonic()
            self.publishers[topic].publish(data)
        self.spin(1.0)

    def cloud(self, size, count):
        """``count`` clouds of ``size`` bytes at 10 Hz on /points, reliable as most drivers send them."""
        publisher = self.node.create_publisher(PointCloud2, "/points", 5)
        points = size // 16
        fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
        message = PointCloud2(
            height=1, width=points, point_step=16, row_step=16 * points, fields=fields, data=array("B", bytes(16 * points))
        )
        message.header.frame_id = "base_link"
        self.spin(2.0)
        for _ in range(count):
            now = time.time_ns()
            message.header.stamp.sec, message.header.stamp.nanosec = now // 10**9, now % 10**9
            publisher.publish(message)
            self.spin(0.1)
        self.spin(1.0)

    def report(self):
        infos = self.node.get_publishers_info_by_topic("/skidloc/odometry")
        return {
            "nodes": sorted(self.node.get_fully_qualified_node_names())
            if hasattr(self.node, "get_fully_qualified_node_names")
            else sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in self.node.get_node_names_and_namespaces()),
            "hashes": [[str(info.topic_type_hash), info.node_name] for info in infos],
            "sent": len(self.sent),
            "answered": len(self.latencies),
            "latencies_s": list(self.latencies.values()),
            "answers_s": [[self.sent[stamp_ns], latency] for stamp_ns, latency in self.latencies.items()],
            "echo_latencies_s": self.echo_latencies,
            "first_s": self.first_s,
            "tf": sorted(set(self.tf)),
            "tf_count": len(self.tf),
            "predicted": self.predicted,
            "frames": sorted({(o.header.frame_id, o.child_frame_id) for o in self.odometry}),
            "poses": [[o.pose.pose.position.x, o.pose.pose.position.y] for o in self.odometry],
            "statuses": self.statuses,
            "grids": [[g.header.frame_id, g.info.width, g.info.height, sum(c == 0 for c in g.data) / len(g.data)] for g in self.grids],
        }


def main():
    robot = Robot(pickle.load(open(sys.argv[1], "rb")))  # noqa: SIM115
    print("up", flush=True)
    for line in sys.stdin:
        command, *numbers = line.split()
        if command == "report":
            print(json.dumps(robot.report()), flush=True)
            continue
        convert = {"cloud": int, "text": str, "call": str}.get(command, float)
        getattr(robot, command)(*map(convert, numbers))
        print("done", flush=True)
    robot.executor.shutdown()
    robot.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
