"""Effects that no cause has get a term, or the name of the time, place, wheel, tilt or sensor that they are bound to."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.extension import ExtendedResult, extend
from localization.diagnosis.model_extension import Extension
from localization.diagnosis.recorded_signals import Side, Signal
from localization.logs import open_log
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.diagnosis_effects import ChangedLog, Effect, Motion, hide
from tests.helpers.diagnosis_windows import drive_of_windows, windows
from tests.helpers.extended import cases

pytestmark = pytest.mark.xdist_group("bound_effects")

MODEL = "diff_drive"
_TILT_RAD = 0.06
_PERIODS: tuple[tuple[Side, float], ...] = (("left", 3.0), ("right", 5.3))
"""Sides, and the time in which the torque of each turns by a radian [s]."""
FOREIGN: dict[str, tuple[Effect, str, float]] = {
    "slip when accelerating": (lambda m: (-0.12 * m.dv, 0.0, 0.0), "vx[dv]", -0.12),
    "encoder scale that grows with speed": (lambda m: (-0.12 * m.v * abs(m.v), 0.0, 0.0), "vx[v*abs(v)]", -0.12),
    "tyres that warm up": (
        lambda m: (0.05 * m.v * (1.0 - np.exp(-4.0 * m.share)), 0.0, 0.0),
        "vx[v*rise(t,24)]",
        0.05,
    ),
}
"""Each with the name and the size that is to be found."""


@functools.cache
def nominal(seed: int, count: int = 48) -> Drive:
    robot = load_robot("pioneer_3dx")
    return drive_of_windows(robot, windows([robot] * count, MODEL, seed))


def stamped(measured: Drive) -> Drive:
    """The windows of ``measured`` with stamps, as those of a log have them."""
    lengths = [m.dt[m.lead :].sum() for m in measured.maneuvers]
    spans = np.stack([measured.starts_s, measured.starts_s + lengths], axis=1)
    return dataclasses.replace(measured, spans_ns=np.round(1e9 * spans).astype(np.int64))


def extended(measured: Drive, model: str = MODEL) -> ExtendedResult:
    made = make_model(model, measured.robot)
    return extend(examine(measured, made), measured, made)


def extension_of(measured: Drive, model: str = MODEL) -> Extension:
    found = extended(measured, model).extension
    assert found is not None
    return found


@pytest.mark.extended
@pytest.mark.parametrize("name", cases(FOREIGN, ["slip when accelerating"]))
def test_extend_foreign_effect_has_its_own_law_and_no_cause(name: str) -> None:
    effect, expected, size = FOREIGN[name]
    result = extended(hide(nominal(1), effect))
    found = result.extension
    assert found is not None
    sizes = {t.term.name: (t.term.value, t.term.sigma) for t in found.terms} | {e.shape.name: (e.value, e.sigma) for e in found.effects}
    assert list(sizes) == [expected]
    assert sizes[expected][0] == pytest.approx(size, abs=3.0 * sizes[expected][1])
    assert not result.found.diagnosis.findings
    assert result.found.diagnosis.verdict in ("extended", "explained")


@pytest.mark.extended
def test_extend_slip_in_a_part_of_the_floor_is_bound_to_the_place() -> None:
    measured = nominal(2, 96)
    found = extension_of(hide(measured, lambda m: (-0.1 * m.v * (m.xy[:, 0] > 0.5 * (m.xy[:, 0].min() + m.xy[:, 0].max())), 0.0, 0.0)))
    assert found.effects[0].shape.kind == "place"
    assert "x = " in found.effects[0].shape.along
    assert found.effects[0].value == pytest.approx(-0.1, abs=0.02)


@pytest.mark.extended
def test_extend_eccentric_wheel_is_bound_to_its_angle() -> None:
    """A left wheel whose axle is off its middle by 8 % of the radius moves the robot ahead as well."""
    measured, track_m = nominal(3, 96), load_robot("pioneer_3dx").geometry.track_width_m

    def eccentric(m: Motion) -> tuple[FloatArray, float, FloatArray]:
        farther = 0.08 * (m.v - 0.5 * track_m * m.wz) * np.cos(m.angles[:, 0])
        return 0.5 * farther, 0.0, -farther / track_m

    found = extension_of(hide(measured, eccentric))
    assert found.effects[0].shape.along == "the left wheels' angle (cosine)"
    assert found.effects[0].value == pytest.approx(0.08, abs=3.0 * found.effects[0].sigma)
    assert "The left wheels' way is +0.0" in found.describe()


@pytest.mark.extended
@pytest.mark.parametrize("side", ["left", "right"])
def test_extend_slip_by_traction_is_bound_to_the_torque(side: Side) -> None:
    """Wheels of one side that slip by 1 % of their way for each newton metre; the other side's torque is another."""
    measured, track_m = stamped(nominal(5, 96)), load_robot("pioneer_3dx").geometry.track_width_m
    times = np.arange(0.0, 1.0 + 2.0 * len(measured.maneuvers), 0.1)
    stamps = np.round(1e9 * times).astype(np.int64)
    torques = {name: Signal(f"the {name} wheels' torque", "torque", "N m", stamps, 3.0 * np.sin(times / k), name) for name, k in _PERIODS}
    sign = -1.0 if side == "left" else 1.0

    def slips(m: Motion) -> tuple[FloatArray, float, FloatArray]:
        lost = -0.01 * torques[side].at(np.round(1e9 * m.t).astype(np.int64)) * np.abs(m.v + sign * 0.5 * track_m * m.wz)
        return 0.5 * lost, 0.0, sign * lost / track_m

    found = extension_of(dataclasses.replace(hide(measured, slips), signals=tuple(torques.values())))
    (effect,) = found.effects
    assert effect.shape.along == f"the {side} wheels' torque"
    assert effect.value == pytest.approx(-0.01, abs=4.0 * effect.sigma)
    assert "models have no torque as an input" in found.describe()


@pytest.mark.extended
def test_extend_radius_that_follows_a_temperature_is_bound_to_it() -> None:
    measured = stamped(nominal(6, 96))
    stamps = 1_000_000_000 * np.arange(2 * len(measured.maneuvers) + 1)
    kelvin = 10.0 * np.sin(np.arange(len(stamps)) / 15.0)
    warm = Signal("the temperature of /tyres", "temperature", "K", stamps, 300.0 + kelvin)

    def grows(m: Motion) -> tuple[FloatArray, float, float]:
        return 0.01 * m.v * warm.at(np.round(1e9 * m.t).astype(np.int64)), 0.0, 0.0

    (effect,) = extension_of(dataclasses.replace(hide(measured, grows), signals=(warm,))).effects
    assert effect.shape.along == "distance times the temperature of /tyres"
    assert effect.value == pytest.approx(0.01, abs=4.0 * effect.sigma)


@pytest.mark.extended
def test_extend_slip_on_slopes_is_bound_to_the_tilt() -> None:
    """The accelerometers show the tilt; a robot slides down in proportion to how far it drives."""
    plain = nominal(4)
    tilts = np.random.default_rng(0).normal(0.0, _TILT_RAD, (len(plain.maneuvers), 2))
    samples = np.repeat(tilts[:, 0], [len(m.dt) for m in plain.maneuvers])
    track = plain.robot.geometry.track_width_m
    sliding = hide(plain, lambda m: (-0.5 * np.hypot(m.v, 0.5 * track * m.wz) * samples, 0.0, 0.0))
    found = extension_of(dataclasses.replace(sliding, forces=9.81 * tilts + _forces_of_motion(plain)))
    assert found.effects[0].shape.kind == "tilt"
    assert found.effects[0].value == pytest.approx(-0.5, abs=0.15)


def _forces_of_motion(measured: Drive) -> FloatArray:
    predictor = examine(measured, make_model(MODEL, measured.robot)).predictor
    assert predictor is not None
    return predictor.kinematic_forces


@pytest.mark.parametrize("seed", cases(range(5, 11), [], others=pytest.mark.slow))
def test_extend_healthy_drive_has_no_term_and_no_effect(seed: int) -> None:
    assert extended(nominal(seed)).extension is None


@pytest.mark.slow
def test_extend_gyro_that_feels_accelerations_is_named_as_such(tmp_path: Path) -> None:
    """Among causes it would be the gyro's clock, 26 ms off."""
    robot = load_robot("husky_a200")
    log = ChangedLog(open_log(bag(tmp_path / "drive.mcap", {}, 21, robot.name, drive("random_5")), robot), 0.03)
    result = extended(drive_of_log(log), "friction")  # type: ignore[arg-type]
    assert result.extension is not None
    (effect,) = result.extension.effects
    assert (effect.shape.component, effect.shape.kind) == ("gyro", "sensor")
    assert "g-sensitivity" in effect.shape.along
    assert effect.value == pytest.approx(0.03, abs=0.002)
    assert not result.found.diagnosis.findings
    assert result.extension.replaced == ("gyro_time_offset",)
