"""What is wrong with the inputs of `tests.studies.entrance_commands`, as changes of the records of a healthy log, and of its files."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from localization.trajectory import Trajectory
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Vehicle, with_times
from tests.studies.entrance_base_logs import BaseLog, healthy
from tests.studies.entrance_command_cases import both, changed, q, shifted, stamp_of, without
from tests.studies.entrance_commands import Edit
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import link, wheel

RPM = 60.0 / math.tau
NAMES = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")


# clocks and order of messages


def then(first: Edit, second: Edit) -> Edit:
    """Both, the second of which leaves the order of the file."""

    def edit(records: list[Record]) -> list[Record]:
        return second(first(records))

    edit.keeps_order = True  # type: ignore[attr-defined]
    return edit


def latched(topic: str, ages_s: tuple[float, ...]) -> Edit:
    """The topic begins with messages of these ages, one of which is stored again and again."""

    def edit(records: list[Record]) -> list[Record]:
        first = next(m for t, m, _ in records if t == topic)
        old = []
        for i, age in enumerate(ages_s):
            copied = bags.STORE.deserialize_cdr(bags.STORE.serialize_cdr(first, first.__msgtype__), first.__msgtype__)
            old.append((topic, with_times(copied, lambda ns, a=age: ns - round(a * S)), START + (i + 1) * S // 1000))
        return [*records, *old]

    return edit


def delivered_late(records: list[Record]) -> list[Record]:
    """A wireless link delivers all messages up to 0.4 s late, in bursts."""
    rng = np.random.default_rng(41)
    delays = rng.uniform(0.0, 0.4, 4000)
    found = []
    for t, m, log in records:
        delay = 0.0 if t == "/tf_static" else float(delays[int((log - START) / S * 4) % 4000])
        found.append((t, m, log + round(delay * S)))
    return found


def whole_seconds(topic: str) -> Edit:
    """The driver fills in seconds alone."""
    return changed(topic, lambda m: with_times(m, lambda ns: ns // S * S))


def set_back(seconds: int, at_s: float) -> Edit:
    """The recorder's clock is set back on the way; stamps are those of the robot's clock. The file is in order of recording."""

    def edit(records: list[Record]) -> list[Record]:
        return [(t, m, log - (seconds * S if log > START + at_s * S else 0)) for t, m, log in records]

    edit.keeps_order = True  # type: ignore[attr-defined]
    return edit


def in_sqlite(edit: Edit) -> Edit:
    """Recorded to a .db3 file, in the order of ``edit``."""

    def stored(records: list[Record]) -> list[Record]:
        return edit(records)

    stored.keeps_order, stored.write = True, lambda path, them: bags.write_ros2_bag(path, them, "sqlite3")  # type: ignore[attr-defined]
    return stored


def jumping(topics: tuple[str, ...], at_s: float, by_s: float) -> Edit:
    return shifted(topics, lambda t: by_s * (t > at_s))


def unstamped(*topics: str) -> Edit:
    return both(*(changed(topic, lambda m: with_times(m, lambda ns: 0)) for topic in topics))


def queued(topics: tuple[str, ...], late_s: Callable[[float], float]) -> Edit:
    """Delivered and recorded late; stamps are those of the measurement."""

    def edit(records: list[Record]) -> list[Record]:
        return [(t, m, log + round(late_s((log - START) / S) * S) if t in topics else log) for t, m, log in records]

    return edit


def in_pairs(topic: str) -> Edit:
    """Two messages of a bus transfer have the stamp of the second."""
    last: list[Any] = []

    def change(message: Any) -> Any:
        last.append(message)
        if len(last) % 2:
            return None
        first = with_times(last[-2], lambda ns: stamp_of(message) - 1)
        return [(topic, first), (topic, message)]

    return changed(topic, change)


def with_losses(topic: str, share: float) -> Edit:
    """A part of the messages never arrives."""
    rng = np.random.default_rng(77)
    return changed(topic, lambda m: None if rng.random() < share else m)


# wheels


def joints(change: Callable[[np.ndarray, np.ndarray], tuple[Any, Any]], topic: str = "/joint_states") -> Edit:
    """Angles and rates changed."""
    return changed(topic, lambda m: bags.joint_state(stamp_of(m), m.name, *change(np.array(m.position), np.array(m.velocity))))


def renamed(*order: int, topic: str = "/joint_states") -> Edit:
    """Wheels under the names of others."""
    return joints(lambda a, r: (a[list(order)], r[list(order)]), topic)


def alternating(message: Any, t: float) -> Any:
    """Every second message has positions alone."""
    if stamp_of(message) // (S // 50) % 2:
        return bags.joint_state(stamp_of(message), message.name, message.position, [])
    return message


def axles(message: Any) -> list[tuple[str, Any]]:
    """A controller for each axle; the left wheels count backwards on both."""
    sign = np.array([-1.0, 1.0])
    found = []
    for topic, pair, late in (("/front/joint_states", [0, 2], 0), ("/rear/joint_states", [1, 3], S // 100)):
        names = [message.name[i] for i in pair]
        a, r = sign * np.array(message.position)[pair], sign * np.array(message.velocity)[pair]
        found.append((topic, bags.joint_state(stamp_of(message) + late, names, a, r)))
    return found


def split(message: Any) -> list[tuple[str, Any]]:
    """A topic for each wheel, rates in revolutions per minute."""
    return [
        (f"/{name}/feedback", bags.joint_state(stamp_of(message) + i * S // 1000, [name], [], [RPM * float(message.velocity[i])]))
        for i, name in enumerate(message.name)
    ]


def wrapped_degrees(position: np.ndarray, velocity: np.ndarray) -> tuple[Any, Any]:
    return np.degrees(position) % 360.0, []


def one_axle(message: Any) -> Any:
    """Encoders on the rear axle alone."""
    rear = [i for i, name in enumerate(message.name) if "rear" in name]
    return bags.joint_state(
        stamp_of(message), [message.name[i] for i in rear], np.array(message.position)[rear], np.array(message.velocity)[rear]
    )


def shuffled(message: Any) -> Any:
    """Joints in another order in each message."""
    order = np.roll(np.arange(len(message.name)), stamp_of(message) // 1_000_000 % len(message.name))
    return bags.joint_state(
        stamp_of(message), [message.name[i] for i in order], np.array(message.position)[order], np.array(message.velocity)[order]
    )


def prefixed(message: Any) -> Any:
    return bags.joint_state(stamp_of(message), [f"a300_00000/{name}" for name in message.name], message.position, message.velocity)


def dead_encoder(position: np.ndarray, velocity: np.ndarray) -> tuple[Any, Any]:
    """Of the rear left wheel."""
    keep = np.array([1.0, 0.0, 1.0, 1.0])
    return keep * position, keep * velocity


def exchanged(position: np.ndarray, velocity: np.ndarray) -> tuple[Any, Any]:
    """Rates as positions, and angles as velocities."""
    return velocity, position


def restarting(at_s: float) -> Edit:
    """The driver is started anew on the way: angles begin at zero again."""
    origin: list[np.ndarray] = []

    def change(m: Any, t: float) -> Any:
        if t < at_s:
            return m
        if not origin:
            origin.append(np.array(m.position))
        return bags.joint_state(stamp_of(m), m.name, np.array(m.position) - origin[0], m.velocity)

    return each("/joint_states", change)


def commands_alone(message: Any) -> list[tuple[str, Any]]:
    """The commanded twist in place of any measurement of wheels."""
    v = 0.16 * float(np.mean(message.velocity))
    twist = bags.T["geometry_msgs/msg/Twist"](linear=bags.vector(v), angular=bags.vector(z=0.1))
    return [("/cmd_vel", twist)]


def arm_beside(message: Any) -> list[tuple[str, Any]]:
    arm = bags.joint_state(stamp_of(message) + S // 400, ["lift", "gripper"], [0.2, 0.0], [0.0, 0.0])
    return [("/wheel_states", message), ("/joint_states", arm)]


def to_twist(radius: float, track: float, unit: float) -> Edit:
    """The driver publishes TwistStamped alone, speeds in another unit."""

    def change(m: Any) -> list[tuple[str, Any]]:
        left, right = radius * np.mean(m.velocity[:2]), radius * np.mean(m.velocity[2:])
        twist = bags.T["geometry_msgs/msg/Twist"](
            linear=bags.vector(unit * (left + right) / 2), angular=bags.vector(z=(right - left) / track)
        )
        return [("/base/twist", bags.T["geometry_msgs/msg/TwistStamped"](header=bags.header(stamp_of(m), "base_link"), twist=twist))]

    return changed("/joint_states", change)


# drivers' odometry


def odometry_in(unit: float) -> Edit:
    """The driver's odometry in another unit of length, without joint states."""

    def change(m: Any) -> Any:
        for place in (m.pose.pose.position, m.twist.twist.linear):
            place.x, place.y = unit * place.x, unit * place.y
        return m

    return both(without("/joint_states"), changed("/odom", change))


def odometry_to_tf(m: Any) -> list[tuple[str, Any]]:
    p = m.pose.pose
    return [("/tf", bags.tf(stamp_of(m), [("odom", "base_footprint", (p.position.x, p.position.y, 0.0), p.orientation)]))]


def turned_about(m: Any) -> Any:
    """Turning rate and heading clockwise, y as it should be."""
    p, twist = m.pose.pose, m.twist.twist
    yaw = 2.0 * math.atan2(p.orientation.z, p.orientation.w)
    return bags.odometry(stamp_of(m), p.position.x, p.position.y, -yaw, twist.linear.x, -twist.angular.z)


def circling(message: Any) -> Any:
    """The driver's odometry has the right encoder reversed: ways are turns, and turns ways."""
    v, w = message.twist.twist.linear.x, message.twist.twist.angular.z
    half = 0.5 * 0.55 * 1.875
    return bags.odometry(stamp_of(message), 0.0, 0.0, 0.0, -w * half, -v / half)


def stretched(factor: float) -> Callable[[Any], Any]:
    """The driver's wheel radius is too large: ways and turns."""

    def change(m: Any) -> Any:
        place, twist = m.pose.pose.position, m.twist.twist
        place.x, place.y, twist.linear.x = factor * place.x, factor * place.y, factor * twist.linear.x
        return m

    return change


def driver_odometry(radius: float, track: float) -> Edit:
    """The driver's odometry of its own geometry in place of joint states, beside others."""
    pose = [0.0, 0.0, 0.0, 0]

    def change(m: Any) -> list[tuple[str, Any]]:
        left, right = radius * np.mean(m.velocity[:2]), radius * np.mean(m.velocity[2:])
        v, w, now = (left + right) / 2, (right - left) / track, stamp_of(m)
        dt = (now - pose[3]) / S if pose[3] else 0.0
        pose[0], pose[1], pose[2] = (
            pose[0] + v * dt * math.cos(pose[2] + w * dt / 2),
            pose[1] + v * dt * math.sin(pose[2] + w * dt / 2),
            pose[2] + w * dt,
        )
        pose[3] = now
        return [("/skid_steer_controller/odom", bags.odometry(now, pose[0], pose[1], pose[2], v, w))]

    def edit(records: list[Record]) -> list[Record]:
        pose[:] = [0.0, 0.0, 0.0, 0]
        return changed("/joint_states", change)(records)

    return edit


# mounts


def laser_edge(x: float, yaw: float = 0.0, frame: str = "laser") -> Edit:
    """The transform of the LiDAR alone."""
    return changed("/tf_static", lambda m: bags.tf(START, [("base_link", frame, (x, 0.0, 0.3), bags.quaternion(yaw))]))


def upside_down(m: Any) -> Any:
    m.ranges = m.ranges[::-1].copy()
    m.angle_min, m.angle_max = -m.angle_max, -m.angle_min
    return m


def rotated(turn: float) -> Edit:
    """Beams as a LiDAR measures them that is turned by ``turn`` [rad] against its transform."""

    def change(m: Any) -> Any:
        m.angle_min, m.angle_max = m.angle_min - turn, m.angle_max - turn
        return m

    return changed("/scan", change)


def inverted_imu(message: Any, t: float) -> Any:
    """The IMU is mounted upside down: y and z point the other way."""
    w, a = message.angular_velocity, message.linear_acceleration
    w.y, w.z, a.y, a.z = -w.y, -w.z, -a.y, -a.z
    return message


# topics


def moved(names: dict[str, str]) -> Edit:
    return lambda records: [(names.get(t, t), m, log) for t, m, log in records]


def beside(base: BaseLog, *topics: str) -> Edit:
    """The truth as Odometry on more topics, 10 Hz."""

    def edit(records: list[Record]) -> list[Record]:
        track, more = healthy(base).reference, []
        for stamp, (x, y, a) in zip(track.stamps_ns[::2], track.poses[::2], strict=True):
            more += [(topic, bags.odometry(int(stamp), x, y, a, 0.3, 0.0), int(stamp) + S // 50) for topic in topics]
        return [*records, *more]

    return edit


def visual_odometry_alone(base: BaseLog, topic: str) -> Edit:
    return both(without("/joint_states"), beside(base, topic))


def filter_alone(base: BaseLog) -> Edit:
    """The filter's odometry and the IMU."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        more = [
            ("/odometry/filtered", bags.odometry(int(t), *p.tolist(), 0.3, 0.0), int(t) + S // 50)
            for t, p in zip(track.stamps_ns[::2], track.poses[::2], strict=True)
        ]
        return [*without("/joint_states")(records), *more]

    return edit


def two_robots(records: list[Record]) -> list[Record]:
    return [(f"/{name}{t}", m, log) for t, m, log in records for name in ("r1", "r2")]


def in_namespace(base: BaseLog, name: str) -> Edit:
    """All topics but /tf in a namespace, beside a filter's odometry there."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        more = [
            (f"/{name}/odometry/filtered", bags.odometry(int(t), *pose.tolist(), 0.3, 0.0), int(t) + S // 50)
            for t, pose in zip(track.stamps_ns[::2], track.poses[::2], strict=True)
        ]
        return [*((t if t.startswith("/tf") else f"/{name}{t}", m, log) for t, m, log in records), *more]

    return edit


def mocap_in(unit: float, base: BaseLog) -> Edit:
    """A PoseStamped of the truth, 5 Hz."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        more = [
            ("/vrpn_client_node/base/pose", bags.pose_stamped(int(t), unit * x, unit * y, a), int(t) + S // 100)
            for t, (x, y, a) in zip(track.stamps_ns[::4], track.poses[::4].tolist(), strict=True)
        ]
        return [*records, *more]

    return edit


# references


def table(
    track: Trajectory, row: Callable[[float, float, float, float], tuple[float, ...]], header: str = "", mark: str = " ", every: int = 2
) -> str:
    lines = [
        mark.join(repr(v) if isinstance(v, int) else f"{v:.7f}" for v in row(stamp / S, *pose))
        for stamp, pose in zip(track.stamps_ns[::every].tolist(), track.poses[::every].tolist(), strict=True)
    ]
    return "\n".join([header, *lines] if header else lines) + "\n"


def gpx_without_times(track: Trajectory) -> str:
    points = "".join(f'<trkpt lat="{47.0 + y / 111195.0:.9f}" lon="{8.0 + x / 75834.0:.9f}"/>' for x, y, _ in track.poses[::10])
    return f'<?xml version="1.0"?><gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>'


def plot_of_rostopic(track: Trajectory) -> str:
    """As `rostopic echo -p` writes a PoseStamped."""
    head = (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y,field.pose.position.z"
    )
    head += ",field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w"
    lines = [head]
    for i, (stamp, (x, y, a)) in enumerate(zip(track.stamps_ns.tolist(), track.poses.tolist(), strict=True)):
        values = ",".join(f"{v:.7f}" for v in (x, y, 0.0, *q(a)))
        lines.append(f"{stamp},{i},{stamp},map,{values}")
    return "\n".join(lines) + "\n"


def plotjuggler(track: Trajectory) -> str:
    return table(
        track,
        lambda t, x, y, a: (t, x, y, a),
        "__time,/ground_truth/pose/pose/position/x,/ground_truth/pose/pose/position/y,/ground_truth/pose/pose/orientation/yaw",
        ",",
        1,
    )


def fixes_late(seconds: float) -> Edit:
    return shifted(("/fix",), lambda t: seconds)


def backwards_in_time(track: Trajectory) -> str:
    """The same way driven back: another run, with the stamps of this one."""
    return table(Trajectory(track.stamps_ns, track.poses[::-1]), lambda t, x, y, a: (t, x, y, 0.0, *q(a + math.pi)))


# descriptions


def by_axes(vehicle: Vehicle, left_roll: float, right_roll: float, more: str = "") -> str:
    """Wheels whose joint frames are rolled so that their z axes lie across: cylinders need no rotation."""
    half, side = vehicle.wheelbase / 2, vehicle.track / 2
    shape = f'<collision><geometry><cylinder radius="{vehicle.radius}" length="0.03"/></geometry></collision>'
    parts = [
        wheel(n, f"{n}_link", x, y, shape, "0 0 1", rpy=f"{left_roll if y > 0 else right_roll} 0 0")
        for n, x, y in zip(NAMES, (half, -half, half, -half), (side, side, -side, -side), strict=True)
    ]
    return f'<robot name="r">{link("base_link")}{"".join(parts)}{more}</robot>'


def visual(radius: float) -> str:
    return f'<visual><origin rpy="1.5708 0 0"/><geometry><cylinder radius="{radius}" length="0.06"/></geometry></visual>'
