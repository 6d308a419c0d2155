"""Centres of gravity: from joint states of the arms where no topic tells them, and none at which the robot would tip over."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

from localization.events import CgSample
from localization.logs.decode import ArmReading
from localization.logs.message_stats import Oddity, Tally
from motion_models.center_of_gravity.model import CgModel
from motion_models.center_of_gravity.parts import support_margin
from motion_models.center_of_gravity.tracker import CgTracker
from motion_models.robot import Geometry


def arms_to_cg(model: CgModel, geometry: Geometry, topic: str, tally: Tally) -> Callable[[ArmReading], Iterator[CgSample]]:
    """Converter of readings in order of time. It is silent until each joint of ``model`` was told once, by whatever message."""
    tracker = CgTracker(model)

    def convert(reading: ArmReading) -> Iterator[CgSample]:
        estimate = tracker.update(reading.names, reading.position)
        if estimate is None:
            return
        sample = CgSample(reading.stamp_ns, estimate.position, estimate.covariance)
        yield from standing(sample, geometry, topic, Oddity.TIPPING, tally)

    return convert


def standing(sample: CgSample, geometry: Geometry, topic: str, oddity: Oddity, tally: Tally) -> Iterator[CgSample]:
    """``sample``, unless the robot would tip over with it, which is counted as ``oddity``."""
    if support_margin(sample.position, geometry.wheelbase_m, geometry.track_width_m) > 0.0:
        yield sample
    else:
        tally.count(topic, oddity)


def covering(wanted: Iterable[str], told: Mapping[str, set[str]]) -> tuple[list[str], list[str]]:
    """The fewest topics that tell all joints ``wanted``, and the joints that none tells. ``told``: topic -> its joints.

    The topic that tells most comes first; one that adds nothing is left out, as it would only repeat what another says.
    """
    left = list(wanted)
    topics: list[str] = []
    while left:
        best = max(told, key=lambda topic: (len(told[topic].intersection(left)), topic), default="")
        if not best or not told[best].intersection(left):
            break
        topics.append(best)
        left = [joint for joint in left if joint not in told[best]]
    return topics, left
