"""Radius, track, wheelbase, mass and driver of a new robot: by the user, URDF and controllers, as far as the log confirms them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

from localization.calibration.robot_draft import Draft, Given
from localization.calibration.urdf_checks import Contradiction, is_tipping
from localization.calibration.wheel_fit import (
    RATE_UNITS,
    DriverFit,
    is_plausible,
    rate_unit,
)
from localization.logs.topic_names import is_other_estimate
from motion_models.center_of_gravity.drive_controllers import TRACKS, ControllerValues
from motion_models.center_of_gravity.parts import TYPICAL
from motion_models.center_of_gravity.urdf_wheels import WheelGeometry
from motion_models.prior import geometric_scaling, scaling_sigma

_LIGHT_ARMS = 0.02
"""Share of the mass in moving parts up to which the centre of gravity is the body's; a spinning LiDAR's."""
_SAME_RADIUS, _SAME_TRACK = 0.1, 0.05
"""Relative differences of two sources below which they agree. Tyres under load and slip straight ahead change a radius by up to 7 %
(DRIVE's Husky); a track is a length of the body."""


def fit_in_radians(
    draft: Draft, given: Given, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> DriverFit | None:
    """``fit`` with the unit of rates that a known radius gives, which goes to the robot file; without a radius that no such robot has."""
    described = _described(urdf, controllers, "wheel_radius_m")
    known = given.wheel_radius_m or (described[0][0] if described else None)
    if fit is None or draft.joints is None:
        return fit
    track = given.track_width_m or next((value for value, _ in _described(urdf, controllers, "track_width_m")), fit.effective_track_m)
    unit = None if known is None else rate_unit(fit.wheel_radius_m, known, track)
    if unit is not None:
        name, radians = unit
        draft.joints = dataclasses.replace(draft.joints, rate_unit_rad_s=radians)
        draft.contradictions.append(
            Contradiction("unit", "joint states", f"rad/s: a radius of {fit.wheel_radius_m:.4g} m for {known:.4g} m", name)
        )
        draft.missing.append(
            f"unit: the wheels' velocities are {name}, by the radius that is known; joints.rate_unit_rad_s = {radians:.6g} is written. "
            "Positions are not compared: run `skidloc check`."
        )
        return dataclasses.replace(fit, wheel_radius_m=fit.wheel_radius_m / radians)
    if is_plausible(fit.wheel_radius_m, track):
        return fit
    radii = ", ".join(f"{fit.wheel_radius_m / radians:.4g} m by {name}" for name, radians in RATE_UNITS.items())
    draft.missing.append(
        f"unit: wheels of {fit.wheel_radius_m:.4g} m, which the log gives by rad/s, carry no robot of a track of {track:.3g} m; "
        f"they are {radii}. Measure them and give --wheel-radius-m: the unit is found by it."
    )
    return dataclasses.replace(fit, wheel_radius_m=math.nan)


def choose_geometry(
    draft: Draft, given: Given, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> None:
    """Choose [geometry] and [driver] of the ``draft``: given, described and confirmed by the log, measured, or those of --like."""
    like = None if given.like is None else given.like.geometry
    of_like = f"that of {'' if given.like is None else given.like.name}"
    is_drivers = not is_other_estimate(draft.topics.get("odometry", "reference"))
    of_log = "the driver's odometry over the wheels' rates" if is_drivers else "the log's motion over the wheels' rates"
    for name, of in (("wheelbase_m", "the URDF's wheels"), ("mass_kg", "the URDF's <inertial>s")):
        of_urdf = None if urdf is None else getattr(urdf, name)
        draft.choose(
            name,
            [(getattr(given, name), "given"), (of_urdf, of), (None if like is None else getattr(like, name), of_like)],
        )
    has_axles = urdf is not None and not urdf.has_one_axle and TRACKS not in urdf.kinds  # of tracks no wheel is in the middle
    if urdf is not None and has_axles and urdf.arms_kg < _LIGHT_ARMS * urdf.mass_kg:
        x, y = urdf.cg
        reason = f"the URDF's <inertial>s, from the middle of the wheels, +- {TYPICAL.com_m:g} m"
        draft.choose("cg_x_m", [(None if is_tipping(urdf) else x, reason)])
        draft.choose("cg_y_m", [(None if urdf.cg_off_middle_m else y, reason)])
    _choose_radius(draft, given.wheel_radius_m, _described(urdf, controllers, "wheel_radius_m"), fit, of_log)
    _choose_track(draft, given.track_width_m, urdf, controllers, fit)
    for name in ("wheel_radius_m", "track_width_m"):
        if name not in draft.values:
            draft.choose(name, [(None if like is None else getattr(like, name), of_like)])
    if urdf is not None and urdf.has_one_axle and not urdf.kinds and "wheelbase_m" not in draft.values:
        draft.choose("wheelbase_m", [(draft.values.get("track_width_m"), "the track; nothing but the driven wheels touches the ground")])
    for name, flag, how in (
        ("wheel_radius_m", "--wheel-radius-m", "from the axle to the floor"),
        ("track_width_m", "--track-width-m", "from contact to contact"),
        ("wheelbase_m", "--wheelbase-m", "from contact to contact"),
    ):
        if name not in draft.values:
            draft.missing.append(f"{name}: measure it ({how}) and give {flag}, or a URDF with --urdf.")
    if "mass_kg" not in draft.values:
        draft.missing.append("mass_kg: weigh the robot and give --mass-kg; 50 kg is written, which only CG and simulation use.")
    _choose_driver(draft, given, controllers, fit if is_drivers else None)


def _described(urdf: WheelGeometry | None, controllers: Iterable[ControllerValues], name: str) -> list[tuple[float, str]]:
    """Finite values (value, source) of URDF and controllers, the most trusted first: joints of wheels without shapes come last."""
    of_urdf = [] if urdf is None else [(float(getattr(urdf, name)), "the URDF's wheels" if urdf.has_shapes else "the URDF's wheel joints")]
    of_controllers = [(float(getattr(c, name)), c.source) for c in controllers]
    ordered = of_urdf + of_controllers if urdf is not None and urdf.has_shapes else of_controllers + of_urdf
    return [(value, source) for value, source in ordered if math.isfinite(value) and value > 0.0]


def _is_same(a: float, b: float, share: float) -> bool:
    return abs(math.log(a / b)) <= share


def _choose_radius(draft: Draft, given: float | None, described: list[tuple[float, str]], fit: DriverFit | None, of_log: str) -> None:
    """The given radius, else the first description that the log confirms, else the log's."""
    name = "wheel_radius_m"
    measured = None if fit is None or math.isnan(fit.wheel_radius_m) else fit.wheel_radius_m
    confirmed = [d for d in described if measured is None or _is_same(d[0], measured, _SAME_RADIUS)]
    draft.choose(name, [(given, "given"), *confirmed, (measured, of_log)])
    if name in draft.values:
        by_log = (
            "no motion"
            if fit is None or measured is None
            else f"{fit.wheel_radius_m:.4g} m (R^2 {fit.r2[0]:.3f}, residual {fit.residuals[0]:.2g} m/s)"
        )
        sources = [*described, *([] if given is None else [(given, "given")])]
        _compare(draft, name, sources, measured or draft.values[name], by_log, _SAME_RADIUS)


def _compare(draft: Draft, name: str, sources: list[tuple[float, str]], right: float, by_log: str, share: float) -> None:
    """Every source as a contradiction where one of them differs from ``right``."""
    if any(not _is_same(value, right, share) for value, _ in sources):
        draft.contradictions += [Contradiction(name, source, f"{value:.4g} m", by_log) for value, source in sources]


def _choose_track(
    draft: Draft, given: float | None, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> None:
    """Where descriptions differ, the one whose k = track / effective track is nearest to that of its geometry."""
    name = "track_width_m"
    described = _described(urdf, controllers, name)
    best = list(described)
    by_log = "cannot decide"
    if fit is not None and described:
        wheelbase = draft.values.get("wheelbase_m")
        is_skid = not draft.is_diff_drive and wheelbase is not None

        def misfit(track: float) -> float:
            expected = geometric_scaling(wheelbase, track) if is_skid and wheelbase is not None else 1.0
            return abs(math.log(track / fit.effective_track_m / expected))

        best = sorted(described, key=lambda d: misfit(d[0]))
        by_log = f"turns by {fit.effective_track_m:.4g} m: k = " + ", ".join(
            f"{track / fit.effective_track_m:.2f} by {track:.4g} m" for track in dict.fromkeys(value for value, _ in described)
        )
        best = best if misfit(described[0][0]) - misfit(best[0][0]) > scaling_sigma() else described
    draft.choose(name, [(given, "given"), *best])
    if name in draft.values:
        _compare(draft, name, [*described, *([] if given is None else [(given, "given")])], draft.values[name], by_log, _SAME_TRACK)


def _choose_driver(draft: Draft, given: Given, controllers: tuple[ControllerValues, ...], fit: DriverFit | None) -> None:
    of_controllers = [(c.wheel_radius_m, c.source) for c in controllers]
    draft.choose(
        "driver_wheel_radius_m",
        [(None if fit is None else fit.wheel_radius_m, "the driver's odometry over the wheels' rates"), *of_controllers],
    )
    track = draft.values.get("track_width_m")
    product = None if fit is None else fit.effective_track_m
    by_log = None if product is None or not track else product / track
    named = []
    for c in controllers:
        turns_by = c.track_width_m / track if track and math.isfinite(c.track_width_m) else 1.0
        named.append((c.wheel_separation_multiplier * turns_by, c.source))
    of_like = None if given.like is None else given.like.driver.wheel_separation_multiplier
    name = "wheel_separation_multiplier"
    draft.choose(
        name,
        [
            (given.wheel_separation_multiplier, "given"),
            (by_log, f"the driver turns by a track of {product or 0.0:.4g} m, by its odometry and the wheels' rates"),
            *named,
            (of_like, "that of the robot named by --like"),
        ],
    )
    if by_log is not None:
        draft.contradictions += [
            Contradiction(name, source, f"{value:.4g}", f"{by_log:.4g} by the driver's odometry")
            for value, source in named
            if math.isfinite(value) and not _is_same(value, by_log, _SAME_TRACK)
        ]
    if name not in draft.values:
        draft.missing.append(
            "wheel_separation_multiplier: 1 is written. Where wheels come from the driver's odometry, look it up in the controller's "
            "parameters and give --wheel-separation-multiplier: the odometry is put backwards through it."
        )
