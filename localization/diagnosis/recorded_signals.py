"""Signals that a log has beside the motion, and that parameters of the robot may follow: the wheels' torques, and temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from localization.logs.event_decoder import MessageDecoder, TopicDecoder
from localization.logs.reader import Log
from motion_models.calibration.maneuvers import IntArray
from motion_models.se2 import FloatArray

Side = Literal["", "left", "right"]
_TEMPERATURE = "sensor_msgs/msg/Temperature"
_LEAST_TORQUE_N_M, _LEAST_TEMPERATURE_K = 0.05, 0.5
"""Standard deviation of a signal below which nothing can follow it: friction of a gear, and resolution of thermistors."""
_FEWEST = 20


@dataclass(frozen=True, eq=False)
class Signal:
    """A number along time."""

    name: str
    """In words, as "the left wheels' torque"."""
    kind: Literal["torque", "temperature"]
    unit: str
    stamps_ns: IntArray
    """(n,) increasing."""
    values: FloatArray
    """(n,)"""
    side: Side = ""
    """Side of the robot whose wheels it is about; empty for all."""

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """(m,) values at ``stamps_ns`` (m,), linear between samples, less their mean."""
        origin = int(self.stamps_ns[0])
        found = np.interp((stamps_ns - origin).astype(float), (self.stamps_ns - origin).astype(float), self.values)
        return np.asarray(found - found.mean())


@dataclass(frozen=True)
class _Sample:
    """A message of one signal or of both sides' torques."""

    stamp_ns: int
    source: str
    values: tuple[float, ...]


def read_signals(log: Log) -> tuple[Signal, ...]:
    """Torques of the wheels by the effort of their joint states, and temperatures, as far as they vary."""
    decoders = {topic: TopicDecoder(0, _temperature(topic)) for topic, kind in log.types.items() if kind == _TEMPERATURE}
    wheels = log.sources.wheels
    if wheels is not None and wheels.kind == "joint_states":
        decoders[wheels.topic] = TopicDecoder(0, _torques(wheels.topic, log.joints, log.robot.joints.reversed))
    samples: dict[str, list[_Sample]] = {}
    for sample in log.readings(decoders) if decoders else ():
        samples.setdefault(sample.source, []).append(sample)
    found: list[Signal] = []
    for source, rows in samples.items():
        stamps, values = np.array([row.stamp_ns for row in rows]), np.array([row.values for row in rows])
        if len(rows) < _FEWEST:
            continue
        if wheels is not None and source == wheels.topic:
            sides: Sequence[Side] = ("left", "right")
            found += [Signal(f"the {side} wheels' torque", "torque", "N m", stamps, values[:, k], side) for k, side in enumerate(sides)]
        else:
            found.append(Signal(f"the temperature of {source}", "temperature", "K", stamps, values[:, 0]))
    least = {"torque": _LEAST_TORQUE_N_M, "temperature": _LEAST_TEMPERATURE_K}
    return tuple(signal for signal in found if signal.values.std() > least[signal.kind])


def _temperature(topic: str) -> MessageDecoder:
    def decode(message: Any, stamp: int) -> _Sample | None:
        return _Sample(stamp, topic, (float(message.temperature),)) if np.isfinite(message.temperature) else None

    return decode


def _torques(topic: str, joints: tuple[tuple[str, ...], tuple[str, ...]], reversed_joints: Sequence[str]) -> MessageDecoder:
    """Decoder of the sum of each side's torques; messages without one of them are left out."""

    def decode(message: Any, stamp: int) -> _Sample | None:
        effort = {name: float(value) for name, value in zip(message.name, message.effort, strict=False)}
        sides = tuple(sum(effort.get(j, np.nan) * (-1.0 if j in reversed_joints else 1.0) for j in side) for side in joints)
        return _Sample(stamp, topic, sides) if np.isfinite(sides).all() else None

    return decode
