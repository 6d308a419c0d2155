"""Messages to events, by the role of their topic, the same for logs and live topics; and readings of wheels, in order of time, to samples.

Angles of wheels are sums of increments: of a reading that wheels cannot reach (a reset encoder or odometry) only that increment is lost,
and is taken from the rates. An angle that wrapped loses nothing. Rates that wheels cannot reach are left out, and with them a reading that
has nothing else.
"""

from __future__ import annotations

import cmath
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from localization.events import CgSample, Event, Scan, WheelSample
from localization.logs.clock_sync import Item
from localization.logs.clouds import cloud_decoder
from localization.logs.decode import (
    ArmReading,
    JointReading,
    MessageStats,
    Oddity,
    OdometryReading,
    UnusableError,
    arm_decoder,
    decode_cg,
    imu_decoder,
    scan_decoder,
    stamp_ns,
)
from localization.logs.topic_roles import Sources, TopicSource
from localization.logs.wheel_messages import ODOMETRY_DECODERS, angle_period_rad, odometry_decoder, wheel_decoder
from motion_models.center_of_gravity.cg_model import CgModel, CgTracker
from motion_models.center_of_gravity.parts import CgEstimate, support_margin
from motion_models.robot import Clock, Driver, Geometry, Lidar, Robot
from motion_models.se2 import FloatArray

_RANKS = {"joint_states": 0, "odometry": 0, "center_of_gravity": 1, "imu": 2, "scan": 3, "points": 3}
_SCAN_WEIGHT = 100

MessageDecoder = Callable[[Any, int], Any]
"""An event, or a reading that becomes one, from a message and its header stamp [ns]; None for a message without content."""

_MAX_SPEED_M_S = 5.0
_MAX_TURN_RATE_RAD_S = 10.0
_MIN_INTERVAL_S = 0.05  # stamps jitter by milliseconds: speeds over shorter times are noise
_STATIONARY_M, _STATIONARY_RAD = 1e-9, 1e-9
_MAX_WRAP_DEVIATION_RAD, _MAX_WRAPPED_STEP_WITHOUT_RATE_RAD = 0.3, 1.0


_MAX_PUBLISHER_GAP_NS = 1_000_000_000  # of a second publisher, after its reading before; drivers publish at 10 Hz and more


_ARE_TWO, _IS_ONE, _CERTAIN = math.log(1e-6), math.log(0.5), math.log(100.0)
"""Logarithms: prior odds that two publishers share a topic; price of labelling a reading; odds from where on one is left out."""
_OUTLIER = math.log(1000.0)
"""Logarithm of the odds that a reading of a single publisher is no outlier: the most that one reading says for two [nats]."""
_RESOLUTION = 1e-3
"""Least scale of changes: less is rounding [m, m/s, rad/s]."""
_DITHER = 2.0
"""Steps of an encoder by which readings of one publisher alternate: a speed or an angle between two counts, of both sides at once."""
_SCALE_STEP = 0.1
"""Step of the logarithm of a scale by each reading."""
_FOLLOW = 0.3
"""Share of a new reading in the mean of readings, which follows a speed that changes within a second."""
_MORE = 1.2
"""Travelled by a second publisher over that of the one in use, from where on the second is used: equal ones do not take turns."""
_FROZEN_AFTER_RAD = 0.5
"""Turned by another wheel of the same side; these are coupled by a chain or by the ground."""
_SAME_CG_NS = 1_000_000_000
"""A centre of gravity that stays is an event no more often than this [ns]; drivers of arms publish at 50 to 500 Hz."""
_NO_POSE_AFTER = 0.1
"""Way [m] or turn [rad] by the twist alone, from where on a pose that never moved is none."""
_SIGMAS = 4.0
"""How far a twist must go beyond what its noise would at rest: a speed's way grows with the messages, that of noise with their root."""
_NO_ANGLES_AFTER_RAD = 0.1
"""Turned by the rates alone, from where on angles that never changed are none: above encoders' steps and the rates' noise at standstill."""


class TopicDecoder(NamedTuple):
    """How the messages of one topic become events or readings."""

    rank: int
    """Order among events of equal stamps."""
    decode: MessageDecoder
    late_ns: int = 0
    """By how much stamps are late, as `motion_models.robot.Clock` has it."""


class EventDecoder:
    """Decodes messages of the topics in use to events. Keeps the last readings of wheels and arms."""

    def __init__(
        self,
        sources: Sources,
        joints: tuple[tuple[str, ...], tuple[str, ...]],
        arms: CgModel | None,
        robot: Robot,
        stats: MessageStats,
        period_s: Mapping[str, float],
    ) -> None:
        """``joints``: names of the left and of the right wheels' joints. ``period_s``: from message to message, by topic [s]."""
        self._sources, self._joints, self._arms = sources, joints, arms
        wheels = "" if sources.wheels is None else sources.wheels.topic
        odometry_type = "" if sources.wheels is None else sources.wheels.type
        self._of_wheels = wheel_decoder((*joints[0], *joints[1]), robot.joints)
        self._period_s, self._imu_unit, self._lidar = period_s, robot.imu.rate_unit_rad_s, robot.lidar
        left, right = joints
        self._length_unit_m = robot.driver.length_unit_m
        self._multipliers = robot.geometry.radius_multipliers
        self._has_multipliers = bool((self._multipliers != 1.0).any())
        least_radius = robot.geometry.wheel_radius_m * min(1.0, float(self._multipliers.min()))
        self.from_joints = JointsToWheels(left, right, least_radius, wheels, stats)
        self.from_joints.angle_period = angle_period_rad(robot.joints, odometry_type)
        self.from_odometry = OdometryToWheels(robot.driver, wheels, stats, is_whole=odometry_type not in ODOMETRY_DECODERS)
        named = " and ".join(source.topic for source in sources.arms)
        self._from_arms = None if arms is None else make_arm_cg_converter(arms, robot.geometry, named, stats)
        self._cg_offset = robot.geometry.cg_offset
        cg_topic = "" if sources.center_of_gravity is None else sources.center_of_gravity.topic
        self._check_cg = partial(check_tipping, geometry=robot.geometry, topic=cg_topic, oddity=Oddity.TIPPING_CG, stats=stats)
        self.decoders: Mapping[str, TopicDecoder] = {
            source.topic: TopicDecoder(_RANKS[source.kind], self._decoder(source, stats), late_ns(source.kind, robot.clock))
            for source in sources.used()
        }
        """By topic."""

    def events(self, payload: Any) -> Iterator[Event]:
        """The events of one decoded message; readings must come in order."""
        if isinstance(payload, JointReading):
            yield from map(self._roll, self.from_joints(payload))
        elif isinstance(payload, ArmReading):
            if (wheels := payload.wheels) is not None:
                yield from map(self._roll, self.from_joints(JointReading(payload.stamp_ns, wheels.position, wheels.velocity)))
            if self._from_arms is not None:
                yield from self._from_arms(payload)
        elif isinstance(payload, OdometryReading):
            yield from map(self._roll, self.from_odometry(payload))
        elif isinstance(payload, CgSample):
            yield from self._check_cg(shift_cg(payload, self._cg_offset))
        elif isinstance(payload, Scan) and not self._lidar.is_exact:
            yield dataclasses.replace(payload, points=_with_true_ranges(payload.points, self._lidar))
        else:
            yield payload

    def _roll(self, sample: WheelSample) -> WheelSample:
        """``sample`` with each side's rate and angle times its wheels' radius multiplier."""
        if not self._has_multipliers:
            return sample
        return dataclasses.replace(sample, velocity=sample.velocity * self._multipliers, position=sample.position * self._multipliers)

    def _decoder(self, source: TopicSource, stats: MessageStats) -> MessageDecoder:
        if source.kind == "joint_states":
            is_wheels = any(wheels.topic == source.topic for wheels in self._sources.all_wheels)
            of_wheels = self._of_wheels if is_wheels else None
            if self._arms is not None and any(arm.topic == source.topic for arm in self._sources.arms):
                return arm_decoder(frozenset(self._arms.chain.joint_names), of_wheels)
            assert of_wheels is not None
            return of_wheels
        if source.kind == "scan":
            return scan_decoder(self._period_s.get(source.topic), partial(stats.count, source.topic))
        if source.kind == "odometry":
            return odometry_decoder(source.type, self._length_unit_m)
        decoders: dict[str, MessageDecoder] = {
            "imu": imu_decoder(self._imu_unit, count=partial(stats.count, source.topic)),
            "center_of_gravity": decode_cg,
            "points": cloud_decoder(self._period_s.get(source.topic)),
        }
        return decoders[source.kind]


def _with_true_ranges(points: FloatArray, lidar: Lidar) -> FloatArray:
    """``points`` (n, 3) in the sensor's frame, each moved along its beam to the true range, (r - offset) / scale [m]."""
    ranges = np.linalg.norm(points, axis=1)
    true = np.maximum(ranges - lidar.range_offset_m, 0.0) / lidar.range_scale
    return np.asarray(points * (true / np.maximum(ranges, 1e-9))[:, None])


CLOCKS = {"joint_states": "wheel", "odometry": "wheel", "imu": "gyro", "scan": "lidar", "points": "lidar"}
"""Sensor of each role, as the entries of `motion_models.robot.Clock` have it."""


def late_ns(kind: str, clock: Clock) -> int:
    """By how much the stamps of a topic in the role ``kind`` are late [ns]."""
    return round(getattr(clock, f"{CLOCKS[kind]}_time_offset_s") * 1e9) if kind in CLOCKS else 0


def rate_error(kind: str, clock: Clock) -> float:
    """By how much faster the clock of a topic in the role ``kind`` runs than the recorder's [s/s]."""
    return float(getattr(clock, f"{CLOCKS[kind]}_rate_error")) if kind in CLOCKS else 0.0


def decode_item(topic: str, log_ns: int, read: Callable[[], Any], decoder: TopicDecoder, stats: MessageStats) -> Item | None:
    """Decode the message that ``read`` returns, recorded at ``log_ns``, to an item to merge; None, and counted, where it is unusable."""
    rank, decode, late_ns = decoder
    try:
        message = read()
        stamp = (stamp_ns(message) if hasattr(message, "header") else 0) - late_ns
        payload = decode(message, stamp)
    except UnusableError as reason:
        stats.count(topic, reason.oddity)
        return None
    except (AttributeError, TypeError, ValueError):  # fields of the type are missing in the log's own definition of it
        stats.count(topic, Oddity.MALFORMED)
        return None
    if payload is None:
        return None
    if isinstance(payload, ArmReading) and payload.wheels is None:
        rank = _RANKS["center_of_gravity"]
    return Item(log_ns, payload.stamp_ns, topic, rank, _SCAN_WEIGHT if rank == 3 else 1, payload)


def make_arm_cg_converter(
    model: CgModel, geometry: Geometry, topic: str, stats: MessageStats
) -> Callable[[ArmReading], Iterator[CgSample]]:
    """Converter of readings in order of time. It yields nothing until each joint of ``model`` was received once, and while the joints rest
    one sample each `_SAME_CG_NS`."""
    tracker = CgTracker(model)
    last: CgEstimate | None = None
    last_ns = 0

    def convert(reading: ArmReading) -> Iterator[CgSample]:
        nonlocal last, last_ns
        estimate = tracker.update(reading.names, reading.position)
        if estimate is None or (estimate is last and reading.stamp_ns - last_ns < _SAME_CG_NS):
            return
        sample = shift_cg(CgSample(reading.stamp_ns, estimate.position, estimate.covariance), geometry.cg_offset)
        for supported in check_tipping(sample, geometry, topic, Oddity.TIPPING, stats):
            last, last_ns = estimate, reading.stamp_ns
            yield supported

    return convert


def shift_cg(sample: CgSample, offset: FloatArray) -> CgSample:
    """``sample`` moved by the robot file's ``offset`` (2,) of every source of the centre of gravity [m]."""
    return dataclasses.replace(sample, position=sample.position + offset) if offset.any() else sample


def check_tipping(sample: CgSample, geometry: Geometry, topic: str, oddity: Oddity, stats: MessageStats) -> Iterator[CgSample]:
    """``sample``, unless the robot would tip over with it, which is counted as ``oddity``."""
    if support_margin(sample.position, geometry.wheelbase_m, geometry.track_width_m) > 0.0:
        yield sample
    else:
        stats.count(topic, oddity)


@dataclass(frozen=True, eq=False)
class _PublisherState:
    """Readings that follow from each other: those of one publisher."""

    reading: JointReading
    """The last one."""
    angle: FloatArray
    """(n,) accumulated [rad]."""
    turned: float = 0.0
    """Sum of the wheels' steps since there are two publishers [rad]."""


@dataclass
class _Publisher:
    stamp_ns: int
    values: list[complex]
    travelled: float = 0.0
    """Since there are two publishers [m]."""


class PublisherSeparator:
    """Separates two publishers that share a topic, of velocities and poses, by the evidence for two.

    Each of two goes on from its own last reading; a single one goes on from the last reading or, where readings are noise about a speed,
    from their mean. The odds of two grow by the density of a reading by two, less the price of a label, over that by one, which has
    either's scales: of one publisher the scales are as free as of two. Densities are Cauchy's, with scales by maximum likelihood, of what
    changes by more than `_DITHER` steps of the encoders. The publisher whose wheels travel more is used, of equal ones one.
    """

    def __init__(self) -> None:
        self._current: _Publisher | None = None
        self._other: _Publisher | None = None
        self._used: _Publisher | None = None
        self._log_odds = _ARE_TWO
        self._largest = 0.0  # cost of the jump that made the other one
        self._sizes: list[float] = []
        self._mean: list[complex] = []
        self._sizes_of_one: tuple[list[float], list[float]] = [], []
        """Scales of changes since the last reading, and from the mean."""
        self._steps: list[float] = []
        """Least change of each value by either of two publishers: the step of an encoder that counts coarsely."""

    def admit(self, stamp_ns: int, values: Sequence[complex], speed: float) -> bool:
        """Whether a reading of ``values`` (velocities, place as x + iy; NaN where absent) at ``speed`` [m/s] is to be used."""
        current = self._current
        if current is None:
            self._current = _Publisher(stamp_ns, list(values))
            self._sizes = [0.0] * len(values)
            self._mean, self._sizes_of_one = list(values), ([0.0] * len(values), [0.0] * len(values))
            self._steps = [math.inf] * len(values)
            return True
        if self._other is not None and stamp_ns - self._other.stamp_ns > _MAX_PUBLISHER_GAP_NS:
            self._other, self._log_odds, self._largest = None, _ARE_TWO, 0.0
        current = self._current = self._chosen(current, stamp_ns, values)
        if math.isfinite(speed):
            current.travelled += speed * (stamp_ns - current.stamp_ns) * 1e-9
        current.stamp_ns, current.values = stamp_ns, list(values)
        if self._other is None or self._log_odds < _CERTAIN:
            return True
        used, rival = (current, self._other) if current is self._used else (self._other, current)
        if used is not self._used or rival.travelled > _MORE * used.travelled:
            self._used = max(used, rival, key=lambda publisher: publisher.travelled)
        return current is self._used

    def _chosen(self, current: _Publisher, stamp_ns: int, values: Sequence[complex]) -> _Publisher:
        """The publisher of a reading; the one before, where it is another, is the other one."""
        changes, other = _changes(values, current.values), self._other
        back = changes if other is None else _changes(values, other.values)
        for found in (changes,) if other is None else (changes, back):
            self._steps = [min(step, change) if change > _RESOLUTION else step for step, change in zip(self._steps, found, strict=True)]
        cost, of_one = self._cost(changes), self._cost_of_one(values, changes)
        if other is not None:
            cost_of_other = self._cost(back)
            of_scales = _log_scales(changes, self._scales(self._sizes))
            gained = min(of_one, cost + of_scales) - min(cost, cost_of_other) - of_scales
            self._log_odds = min(max(self._log_odds + min(_OUTLIER, gained) + _IS_ONE, _ARE_TWO), 2.0 * _CERTAIN)
            if cost_of_other < cost:
                self._learn(back)
                self._other = current
                return other
        self._largest += _IS_ONE
        if self._log_odds < _CERTAIN and cost > self._largest:
            self._other, self._largest = replace(current, travelled=0.0), cost
            current.travelled = 0.0
        else:
            self._learn(changes)
        return current

    def _cost(self, changes: Sequence[float]) -> float:
        """Minus the logarithm of the density of ``changes`` by either of two publishers, without that of the scales."""
        return _cauchy(self._beyond_dither(changes), self._scales(self._sizes))

    def _cost_of_one(self, values: Sequence[complex], changes: Sequence[float]) -> float:
        """Minus the logarithm of the density of ``values`` by a single publisher, of whose two predictions the better one so far counts."""
        off = _changes(values, self._mean)
        last, mean = self._sizes_of_one
        pairs = zip(last, changes, mean, off, strict=True)
        found = [(size, change) if size <= other else (other, from_mean) for size, change, other, from_mean in pairs]
        scales = self._scales([size for size, _ in found])
        self._sizes_of_one = _fitted(last, changes), _fitted(mean, off)
        self._mean = [
            m if not cmath.isfinite(v) else v if cmath.isnan(m) else m + _FOLLOW * (v - m) for m, v in zip(self._mean, values, strict=True)
        ]
        of_one = [change for _, change in found]
        return _cauchy(self._beyond_dither(of_one), scales) + _log_scales(of_one, scales)

    def _beyond_dither(self, changes: Sequence[float]) -> list[float]:
        """What ``changes`` are more than encoders that count forth and back."""
        return [
            change if math.isinf(step) else max(change - _DITHER * step, 0.0 * change)
            for change, step in zip(changes, self._steps, strict=True)
        ]

    def _scales(self, sizes: Sequence[float]) -> list[float]:
        """Scales of the densities of changes of such ``sizes``: no value is finer than its step."""
        return [max(size, _RESOLUTION, step if step < math.inf else 0.0) for size, step in zip(sizes, self._steps, strict=True)]

    def _learn(self, changes: Sequence[float]) -> None:
        self._sizes = _fitted(self._sizes, changes)


def _changes(values: Sequence[complex], before: Sequence[complex]) -> list[float]:
    """Sizes of the changes of ``values`` from those ``before``; NaN where they are not known.

    Not by abs(): that of a complex NaN raises OverflowError where an earlier call of C has left errno at ERANGE (CPython 3.11).
    """
    differences = [a - b for a, b in zip(values, before, strict=True)]
    changes = [math.hypot(difference.real, difference.imag) for difference in differences]
    return [change if change < math.inf else math.nan for change in changes]


def _cauchy(changes: Sequence[float], scales: Sequence[float]) -> float:
    """Minus the logarithm of Cauchy's density of ``changes``, without that of its ``scales``; NaN changes are unknown."""
    known = [change / scale for change, scale in zip(changes, scales, strict=True) if change == change]
    return sum(2.0 * math.log(math.hypot(1.0, change)) for change in known)


def _log_scales(changes: Sequence[float], scales: Sequence[float]) -> float:
    """Logarithm of the ``scales`` of known ``changes``, which `_cauchy` leaves out."""
    return sum(math.log(scale) for change, scale in zip(changes, scales, strict=True) if change == change)


def _fitted(sizes: Sequence[float], changes: Sequence[float]) -> list[float]:
    """Scales ``sizes`` of Cauchy's density, a step up its likelihood by new ``changes``; NaN ones, and those of a robot at rest, move none.

    d ln p / d ln s = (c^2 - s^2) / (c^2 + s^2): no change counts more than another of another order of size.
    """
    found = []
    for size, change in zip(sizes, changes, strict=True):
        if not change > _RESOLUTION:
            found.append(size)
        elif size == 0.0:
            found.append(change)
        else:
            found.append(size * math.exp(_SCALE_STEP * (1.0 - 2.0 / (1.0 + (change / size) * (change / size)))))
    return found


class JointsToWheels:
    """Converter of readings whose first ``left`` joints are the left side's and the next ``right`` the right side's.

    Where two publishers share the topic, angles alternate between theirs. The one whose wheels turn more is used: the other is mostly a
    `joint_state_publisher` that publishes zeros.
    """

    def __init__(self, left: Sequence[str], right: Sequence[str], wheel_radius_m: float, topic: str, stats: MessageStats) -> None:
        """``left`` and ``right``: names of the joints."""
        self._left, self._names = len(left), (*left, *right)
        self._radius, self._topic, self._stats = wheel_radius_m, topic, stats
        self._publisher: _PublisherState | None = None
        self._second_publisher: _PublisherState | None = None
        self._rates = PublisherSeparator()
        self._has_turned = False
        self._failing = FailingEncoders(self._left, len(self._names))
        self._by_rates, self._last_ns = np.zeros(len(self._names)), 0  # turned while no angle has changed [rad]
        self.angle_period = math.tau
        """After which angles wrap [rad]."""
        self._least, self._most = [math.inf] * len(self._names), [-math.inf] * len(self._names)

    def __call__(self, reading: JointReading) -> Iterator[WheelSample]:
        """The wheel sample of the next reading; none where it is not used."""
        has_angles = all(map(math.isfinite, reading.position.tolist()))
        if not has_angles:
            reading = self._hold_unknown(reading)
            has_angles = bool(np.isfinite(reading.position).all())
        velocity = reading.velocity
        if any(abs(rate) * self._radius > _MAX_SPEED_M_S for rate in velocity.tolist()):
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not has_angles:
                return
            velocity = np.where(np.abs(velocity) * self._radius > _MAX_SPEED_M_S, np.nan, velocity)
        if not has_angles:
            yield from self._convert_rates(reading.stamp_ns, velocity)
            return
        if self._has_constant_angles(reading, velocity):
            self._stats.count(self._topic, Oddity.CONSTANT_ANGLES)
            yield WheelSample(reading.stamp_ns, self._side_means(velocity), np.full(2, np.nan))
            return
        positions = reading.position.tolist()
        self._least, self._most = list(map(min, self._least, positions)), list(map(max, self._most, positions))
        publisher = self._publisher
        if publisher is None:
            publisher = self._publisher = _PublisherState(reading, reading.position)
        elif self._is_reachable(publisher, reading):
            publisher = self._publisher = self._accumulate(publisher, reading, reading.position - publisher.reading.position)
        elif self._second_publisher is not None and self._is_reachable(self._second_publisher, reading):
            publisher, self._second_publisher = (
                self._accumulate(self._second_publisher, reading, reading.position - self._second_publisher.reading.position),
                publisher,
            )
            self._publisher = publisher
            if publisher.turned < self._second_publisher.turned:
                self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
                return
        else:
            step, is_reset = self._corrected_step(publisher.reading, reading, velocity)
            if is_reset:
                self._stats.count(self._topic, Oddity.WHEEL_JUMP)
                self._second_publisher = replace(publisher, turned=0.0)
                publisher = replace(publisher, turned=0.0)
            publisher = self._publisher = self._accumulate(publisher, reading, step)
        for i in self._failing.joints:
            self._stats.count(f"{self._topic}, joint '{self._names[i]}'", Oddity.FROZEN_WHEEL)
        yield WheelSample(reading.stamp_ns, self._side_means(velocity), self._side_means(publisher.angle))

    def frozen_wheels(self) -> tuple[FrozenWheel, ...]:
        """Joints whose encoders failed, so far."""
        lost = zip(self._names, self._failing.lost.tolist(), strict=True)
        return tuple(FrozenWheel(name, messages, spells) for name, (messages, spells) in lost if spells)

    def _hold_unknown(self, reading: JointReading) -> JointReading:
        """``reading`` with the last angles of joints whose angles are NaN while others have some."""
        unknown = ~np.isfinite(reading.position)
        if unknown.all():
            return reading
        last = np.zeros(len(unknown)) if self._publisher is None else self._publisher.reading.position
        return replace(reading, position=np.where(unknown, last, reading.position))

    def _has_constant_angles(self, reading: JointReading, velocity: FloatArray) -> bool:
        """Whether no angle has changed yet, though the wheels have turned by their rates."""
        publisher = self._publisher
        if publisher is None or self._has_turned or (reading.position != publisher.reading.position).any():
            return False
        passed_s = (reading.stamp_ns - max(self._last_ns, publisher.reading.stamp_ns)) * 1e-9
        self._by_rates += np.nan_to_num(velocity) * min(max(passed_s, 0.0), _MAX_PUBLISHER_GAP_NS * 1e-9)
        self._last_ns = reading.stamp_ns
        return bool(np.abs(self._by_rates).max() > _NO_ANGLES_AFTER_RAD)

    def _convert_rates(self, stamp_ns: int, velocity: FloatArray) -> Iterator[WheelSample]:
        """A reading without angles, unless it is of a second publisher."""
        angles = self._publisher
        if angles is not None and stamp_ns - angles.reading.stamp_ns <= _MAX_PUBLISHER_GAP_NS and self._has_turned:
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)  # wheels that have turned by their angles have these
            return
        speed = velocity * self._radius
        travel_m_s = float(np.nanmax(np.abs(speed))) if np.isfinite(speed).any() else 0.0
        if not self._rates.admit(stamp_ns, speed.tolist(), travel_m_s):
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
            return
        yield WheelSample(stamp_ns, self._side_means(velocity), np.full(2, np.nan))

    def _is_reachable(self, publisher: _PublisherState, reading: JointReading) -> bool:
        """Whether wheels can have turned from the last reading of ``publisher`` to ``reading``."""
        passed_ns = reading.stamp_ns - publisher.reading.stamp_ns
        if publisher is self._second_publisher and passed_ns > _MAX_PUBLISHER_GAP_NS:
            return False
        step = max(map(abs, (reading.position - publisher.reading.position).tolist()))  # faster than numpy on four numbers
        if step > 0.5 * self.angle_period and any(self._on_circle()):
            return False
        return bool(step * self._radius <= _MAX_SPEED_M_S * max(passed_ns * 1e-9, _MIN_INTERVAL_S))

    def _on_circle(self) -> list[bool]:
        """Joints whose angles have stayed within one period so far: they may wrap."""
        return [most - least <= self.angle_period * (1.0 + 1e-6) for least, most in zip(self._least, self._most, strict=True)]

    def _accumulate(self, publisher: _PublisherState, reading: JointReading, step: FloatArray) -> _PublisherState:
        turned = publisher.turned if self._second_publisher is None else publisher.turned + sum(map(abs, step.tolist()))
        self._has_turned = self._has_turned or bool(step.any())
        return _PublisherState(reading, publisher.angle + self._failing.replace(step), turned)

    def _corrected_step(self, known: JointReading, reading: JointReading, velocity: FloatArray) -> tuple[FloatArray, bool]:
        """(n,) increments where some are too large: of an angle that wrapped, or from the rates for one that was reset; whether one was."""
        dt = (reading.stamp_ns - known.stamp_ns) * 1e-9
        step = reading.position - known.position
        is_too_fast = np.abs(step) * self._radius > _MAX_SPEED_M_S * max(dt, _MIN_INTERVAL_S)
        expected = np.nan_to_num(velocity) * dt
        wrapped = np.remainder(step + 0.5 * self.angle_period, self.angle_period) - 0.5 * self.angle_period
        deviation = np.where(np.isfinite(velocity), _MAX_WRAP_DEVIATION_RAD, _MAX_WRAPPED_STEP_WITHOUT_RATE_RAD)
        is_wrap = (np.abs(step) < 1.5 * self.angle_period) & (np.abs(wrapped - expected) < deviation)  # one period, never two
        may_wrap = is_too_fast | ((np.abs(step) > 0.5 * self.angle_period) & np.array(self._on_circle()))
        corrected = np.where(may_wrap & is_wrap, wrapped, np.where(is_too_fast, expected, step))
        return corrected, bool((is_too_fast & ~is_wrap).any())

    def _side_means(self, values: FloatArray) -> FloatArray:
        numbers = self._failing.fill(values).tolist()
        return np.array([sum(numbers[: self._left]) / self._left, sum(numbers[self._left :]) / (len(numbers) - self._left)])


class FrozenWheel(NamedTuple):
    """A wheel joint whose angle did not change while another wheel of its side turned."""

    joint: str
    messages: int
    spells: int


class FailingEncoders:
    """Joints whose angles do not change while another wheel of their side turns: what that one turns is theirs, until they count again.

    Wheels of a side are coupled by a chain or by the ground.
    """

    def __init__(self, left: int, n: int) -> None:
        """The first ``left`` of ``n`` joints are the left side's."""
        self._sides = (np.arange(left), np.arange(left, n))
        self._missing = np.zeros(n)  # what the others have turned on average since a joint last turned [rad]
        self._idle = np.zeros(n)  # the sizes of their steps
        self._silent = np.zeros(n, dtype=int)  # messages of these
        self.joints: list[int] = []
        """Those that fail now."""
        self.lost = np.zeros((n, 2), dtype=int)
        """Messages and spells of each joint in which it failed, so far."""

    def replace(self, step: FloatArray) -> FloatArray:
        """Increments (n,) with those of failing joints replaced; where one is found, with what it has lost."""
        is_turning = [abs(one) > _STATIONARY_RAD for one in step.tolist()]
        if not self.joints and (all(is_turning) or not any(is_turning)):
            if is_turning[0]:
                self._missing[:] = self._idle[:] = 0.0
                self._silent[:] = 0
            return step
        found, before = step.copy(), frozenset(self.joints)
        self.joints = []
        for side in self._sides:
            turning = [i for i in side if is_turning[i] and i not in before]
            mean = float(step[turning].mean()) if turning else 0.0
            for i in side:
                if is_turning[i]:
                    found[i] = mean if i in before and turning else step[i]  # counts again, from wherever
                    self._missing[i] = self._idle[i] = 0.0
                    self._silent[i] = 0
                    continue
                self._missing[i] += mean
                self._idle[i] += abs(mean)
                self._silent[i] += mean != 0.0
                if self._idle[i] > _FROZEN_AFTER_RAD:
                    self.joints.append(int(i))
                    self.lost[i] += (mean != 0.0, 0) if i in before else (self._silent[i], 1)
                    found[i] = mean if i in before else self._missing[i]
        return found

    def fill(self, values: FloatArray) -> FloatArray:
        """``values`` (n,), those of failing joints replaced by the mean of the others of their side, where there are such."""
        if not self.joints:
            return values
        found = values.copy()
        for side in self._sides:
            working = [i for i in side if i not in self.joints]
            if working:
                found[[i for i in side if i in self.joints]] = values[working].mean()
        return found


class OdometryToWheels:
    """Converter by the driver's own geometry, inverted: q = (vx -+ wz w_s d/2)/r (Ebersole 2016, eq. 1.4-1.8).

    Angles come from the pose, which has all the motion though messages were lost, rates from the twist. A driver may fill only
    one of the two.
    """

    def __init__(self, driver: Driver, topic: str, stats: MessageStats, *, is_whole: bool = True) -> None:
        """``is_whole``: messages have a pose and a twist by their type; where they do not, its absence is not counted."""
        self._is_whole = is_whole
        self._radius = driver.wheel_radius_m
        self._half_track = driver.half_track_m
        self._topic, self._stats = topic, stats
        self._previous: OdometryReading | None = None
        self._angle = np.zeros(2)
        self._pose_has_moved = self._twist_has_moved = False
        self._by_twist = np.zeros(2)  # way and turn while the pose has not moved [m, rad]
        self._jitter = np.zeros(2)  # their variance, were the twist noise alone
        self._publishers = PublisherSeparator()

    def __call__(self, reading: OdometryReading) -> Iterator[WheelSample]:
        """The wheel sample of the next reading; none where it is not used."""
        twist = [math.nan] * 3 if self._pose_has_moved else reading.twist.tolist()  # speeds and headings jump by a count and return
        values = [*twist, complex(*reading.pose[:2].tolist())]
        if not self._publishers.admit(reading.stamp_ns, values, float(np.hypot(*reading.twist[:2]))):
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
            return
        vx, _, wz = reading.twist
        is_out_of_range = abs(vx) > _MAX_SPEED_M_S or abs(wz) > _MAX_TURN_RATE_RAD_S
        if is_out_of_range:
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not math.isfinite(sum(reading.pose)) or (self._twist_has_moved and not self._pose_has_moved):
                return  # the next message covers this time too
        twist_is_known = math.isfinite(vx) and math.isfinite(wz) and not is_out_of_range
        self._twist_has_moved |= twist_is_known and bool(vx != 0.0 or wz != 0.0)
        rate = self._wheels(vx, wz) if twist_is_known else np.full(2, np.nan)
        if not self._is_whole and not math.isfinite(sum(reading.pose)):
            yield WheelSample(reading.stamp_ns, rate, np.full(2, np.nan))
            return
        previous = self._previous
        if previous is not None:
            dt = (reading.stamp_ns - previous.stamp_ns) * 1e-9
            forward, turn = arc(previous.pose, reading.pose)
            from_twist = (vx * dt, wz * dt) if twist_is_known else (0.0, 0.0)
            moved = abs(forward) > _STATIONARY_M or abs(turn) > _STATIONARY_RAD
            longest = max(dt, _MIN_INTERVAL_S)
            if not (abs(forward) <= _MAX_SPEED_M_S * longest and abs(turn) <= _MAX_TURN_RATE_RAD_S * longest):
                self._stats.count(self._topic, Oddity.POSE_JUMP)
                forward, turn = from_twist
            elif moved:
                self._pose_has_moved = True
            elif not self._pose_has_moved and self._twist_has_moved:
                self._by_twist += from_twist
                self._jitter += np.square(from_twist)
                if (np.abs(self._by_twist) > np.maximum(_NO_POSE_AFTER, _SIGMAS * np.sqrt(self._jitter))).any():
                    self._stats.count(self._topic, Oddity.NO_POSE)
                forward, turn = from_twist
            increment = self._wheels(forward, turn)
            if not self._twist_has_moved and moved and dt > 0.0:
                if self._is_whole:
                    self._stats.count(self._topic, Oddity.NO_TWIST)
                rate = increment / dt
            self._angle = self._angle + increment
        self._previous = reading
        yield WheelSample(reading.stamp_ns, rate, self._angle)

    def _wheels(self, forward: float, turn: float) -> FloatArray:
        return driven_wheels(np.array([forward, turn]), self._half_track, self._radius)


def driven_wheels(motion: FloatArray, half_track_m: float, wheel_radius_m: float) -> FloatArray:
    """(..., 2) left and right wheel by a driver that moves the robot ahead and turns it by ``motion`` (..., 2): rates of its speeds, angles
    of its ways. The inverse of Ebersole 2016, eq. 1.4-1.8."""
    forward, turn = motion[..., 0], motion[..., 1]
    return np.stack([forward - turn * half_track_m, forward + turn * half_track_m], axis=-1) / wheel_radius_m


def arc(world_T_a: FloatArray, world_T_b: FloatArray) -> tuple[float, float]:
    """Signed length [m] and angle [rad] of the circular arc from a to b; backwards is negative."""
    dx, dy = world_T_b[0] - world_T_a[0], world_T_b[1] - world_T_a[1]
    turn = math.remainder(world_T_b[2] - world_T_a[2], math.tau)
    middle = world_T_a[2] + 0.5 * turn
    chord = math.copysign(math.hypot(dx, dy), dx * math.cos(middle) + dy * math.sin(middle))
    half = 0.5 * turn
    return chord * (half / math.sin(half) if abs(half) > 1e-8 else 1.0), turn
