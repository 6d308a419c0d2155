"""What in a URDF contradicts itself or the models here: kinds of wheels, axes, radii, the body frame, and the centre of gravity."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from localization.calibration.wheel_fit import WheelSides
from motion_models.center_of_gravity.drive_controllers import CASTERS, MECANUM, OMNI, STEERED, TRACKS
from motion_models.center_of_gravity.urdf import first_names
from motion_models.center_of_gravity.urdf_wheels import WheelGeometry

KIND_NOTES = {
    MECANUM: "they move sideways by command, which no model here has; lateral motion will be taken for slip.",
    OMNI: "they move sideways by command, which no model here has; lateral motion will be taken for slip.",
    TRACKS: "they have no wheelbase; the length of their contact stands for it, and their sprockets' rates for the wheels'.",
    STEERED: "steering is not modelled; only the driven wheels of a body that turns by their difference are.",
    CASTERS: "not driven and left out of wheels and track; with one driven axle the wheelbase reaches to them.",
}
_LATERAL = 0.7
"""Least component along y of a wheel's axis."""
_OFF_BODY = 0.1
"""Distance of the wheels' middle from the body frame over track or wheelbase from which it is named."""


@dataclass(frozen=True)
class Contradiction:
    """A source that differs from another, or from the log."""

    quantity: str
    source: str
    value: str
    by_log: str
    """What the log measured of it."""


@dataclass
class Findings:
    """Sentences and contradictions."""

    reasons: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    contradictions: list[Contradiction] = field(default_factory=list)


def check_urdf(urdf: WheelGeometry, values: Mapping[str, float], measured: WheelSides | None) -> Findings:
    """Everything to name of a ``urdf``, given the chosen ``values`` of [geometry] and the sides that a log ``measured``."""
    found = Findings()
    for kind in urdf.kinds:
        of = f" ({first_names(urdf.casters)})" if kind == CASTERS and urdf.casters else ""
        (found.reasons if kind == CASTERS else found.missing).append(f"{kind}{of}: {KIND_NOTES[kind]}")
    if not urdf.positions:
        return found
    if not urdf.has_names:
        names = first_names(urdf.positions)
        found.reasons.append(f"wheels: {names}, by their axes and places; no joint is called a wheel.")
    if len(urdf.left) != len(urdf.right):
        left, right = ", ".join(urdf.left), ", ".join(urdf.right)
        found.missing.append(f"wheels: {left} on the left, but {right} on the right; the models here have as many on both sides.")
    if urdf.off_axis:
        where = "not about the axes of their joints"
        found.contradictions.append(
            Contradiction("wheels", f"the URDF's shapes of {first_names(urdf.off_axis)}", where, "joints are taken")
        )
    _check_axes(found, urdf, measured)
    _check_radii(found, urdf, values)
    if TRACKS not in urdf.kinds:  # of tracks no sprocket need be in the middle
        _check_body_frame(found, urdf)
    _check_controllers(found, urdf)
    _check_center_of_gravity(found, urdf)
    return found


def _check_axes(found: Findings, urdf: WheelGeometry, measured: WheelSides | None) -> None:
    """Name wheels whose axes are not to the left, as REP 103 has it: their rates may have the other sign, or the body frame is turned."""
    across = [name for name, axis in urdf.axes.items() if abs(axis[1]) < _LATERAL]
    if across:
        found.missing.append(
            f"wheel axes: {', '.join(across)} do not turn about the y axis of the body frame; if its x axis does not point forward, "
            "left, right, track and wheelbase are mixed up. Check <axis> and rpy, or name another link with --base-link."
        )
        return
    opposite = [name for name, axis in urdf.axes.items() if axis[1] < 0.0]
    if not opposite:
        return
    by_log = "cannot decide"
    if measured is not None:
        backwards = [name for name in opposite if name in measured.reversed]
        by_log = "negative when driving forward" if len(backwards) == len(opposite) else "positive when driving forward"
    found.contradictions.append(Contradiction("sign", "the URDF's <axis>", f"{', '.join(opposite)}: to the right (0 -1 0)", by_log))


def _check_radii(found: Findings, urdf: WheelGeometry, values: Mapping[str, float]) -> None:
    if urdf.radii and math.isnan(urdf.wheel_radius_m):
        radii, used = (", ".join(f"{radius:.4g} m" for radius in urdf.radii)), values.get("wheel_radius_m")
        taken = "none is taken" if used is None else f"{used:.4g} m is taken"
        found.contradictions.append(Contradiction("wheel_radius_m", "the URDF's wheels differ", radii, taken))


def _check_controllers(found: Findings, urdf: WheelGeometry) -> None:
    """Name joints that a <plugin> drives and that are no wheels of the URDF."""
    for controller in urdf.controllers:
        others = [name for name in (*controller.left, *controller.right) if name not in urdf.positions]
        if others and TRACKS not in urdf.kinds:
            found.contradictions.append(Contradiction("wheels", controller.source, first_names(others), "no wheels of the URDF"))


def _check_body_frame(found: Findings, urdf: WheelGeometry) -> None:
    """Name a body frame that is not in the middle of the wheels, about which the models turn."""
    x, y = urdf.middle
    wheelbase = 0.0 if urdf.has_one_axle or math.isnan(urdf.wheelbase_m) else urdf.wheelbase_m
    if math.hypot(x, y) > _OFF_BODY * max(urdf.track_width_m, wheelbase):
        found.missing.append(
            f"body frame: the middle of the driven wheels is at ({x:+.3f}, {y:+.3f}) m of it, and turning in place is about there. "
            "Name a link in the middle with --base-link, or poses of the base move when it turns."
        )


def _check_center_of_gravity(found: Findings, urdf: WheelGeometry) -> None:
    """Name masses off the middle of symmetric wheels, or outside of the wheels."""
    ahead, aside = urdf.cg
    if urdf.cg_off_middle_m > 0.0:
        found.contradictions.append(
            Contradiction(
                "centre of gravity, y", "the URDF's <inertial>s", f"{aside:+.3f} m", "cannot measure it; wheels are symmetric: 0 m"
            )
        )
        side = "left" if aside > 0.0 else "right"
        found.missing.append(
            f"centre of gravity: the URDF's masses have it {100.0 * abs(aside):.0f} cm off the middle of a symmetric robot "
            f"(to the {side}): check <inertial> of the body (axes swapped?). cg_y_m = 0 is written, which is +- {abs(aside):.2f} m "
            "until the robot is weighed (`skidloc cg`), not +- 0.005 m."
        )
    if is_tipping(urdf):
        where = "ahead of the front" if ahead > 0.0 else "behind the rear"
        found.missing.append(
            f"centre of gravity: the URDF's masses have it {100.0 * abs(ahead):.0f} cm from the middle of the wheels, {where} axle, "
            "where the robot tips over: check <inertial>. cg_x_m = 0 is written."
        )


def is_tipping(urdf: WheelGeometry) -> bool:
    """Whether the centre of gravity of a robot of several axles is not between them."""
    return not urdf.has_one_axle and TRACKS not in urdf.kinds and abs(urdf.cg[0]) > urdf.wheelbase_m / 2.0
