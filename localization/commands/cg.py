"""`skidloc cg`: the centre of gravity from scales, arms and payload, how sure it is, and what it does to the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from localization.commands.common import add_row, plain_table, print_line, print_table, write_json
from localization.output import check_outputs
from motion_models.center_of_gravity.cg_model import Posture, parse_postures, static_part_from_weighing
from motion_models.center_of_gravity.files import arms_model, arms_postures, weighed_cg
from motion_models.center_of_gravity.parts import Arms, CgEstimate, Payload, StaticPart, require_support
from motion_models.center_of_gravity.urdf_wheels import wheel_geometry
from motion_models.center_of_gravity.weighing import WHEELS, WeighedCg, read_weighings
from motion_models.errors import CgError, RobotError, no_such
from motion_models.friction import FrictionModel
from motion_models.friction.contact import loads
from motion_models.input_files import read_text
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.skid_steer import SkidSteer


@dataclass(frozen=True)
class Cg:
    """Compute the centre of gravity from scales, arms and payload."""

    weighings: tyro.conf.Positional[Path | None] = None
    """CSV of weighings, one a line: front_left_kg, front_right_kg, rear_left_kg, rear_right_kg."""
    robot: str = "vaultbot"
    """Name of a shipped robot, or path of a robot TOML file: wheelbase, track, arms and models."""
    urdf: Path | None = None
    """URDF with the masses, instead of the one that the robot file names."""
    base_link: str = "base_link"
    """Link of --urdf whose frame is the body frame."""
    srdf: Path | None = None
    """SRDF with named postures, instead of the one that the robot file names."""
    posture: str = ""
    """Named posture of the arms."""
    joint: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE [rad or m], again for each joint; goes before --posture. All joints that move mass must be named by one of both."""
    weighed_posture: str = ""
    """Named posture of the arms on the scales. Then the arms are taken off the weighing, and put back as they stand now."""
    payload: float = 0.0
    """Mass held at --at [kg]."""
    payload_sigma: float = 0.0
    """Its standard deviation [kg]."""
    at: str = ""
    """Link that holds the payload, such as a gripper."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass of the payload in that link's frame [m]."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        robot = load_robot(self.robot)
        check_outputs(self.json)
        g = robot.geometry
        weighed = None if self.weighings is None else weighed_cg(self.weighings, g.wheelbase_m, g.track_width_m)
        uses_arms = bool(self.posture or self.joint or self.payload or self.urdf or self.weighed_posture)
        if weighed is None and not uses_arms:
            raise CgError("name what a centre of gravity is found by: a CSV of weighings, a --posture, or --joint NAME=VALUE.")
        source, static = [], None
        if weighed is not None:
            source.append(f"{weighed.weighings} weighing{'s' if weighed.weighings > 1 else ''}")
        if weighed is not None and not uses_arms:
            estimate = CgEstimate(weighed.position, weighed.covariance[1:, 1:], weighed.mass)
        else:
            estimate, static, steps = self._with_arms(robot, weighed)
            source += steps
        if weighed is None and self.urdf is None:
            estimate = CgEstimate(estimate.position + g.cg_offset, estimate.covariance, estimate.mass)
        off_middle = 0.0 if weighed is not None or self.urdf is None else _off_middle(self.urdf, self.base_link)
        if off_middle:
            estimate = CgEstimate(estimate.position, estimate.covariance + np.diag([0.0, off_middle**2]), estimate.mass)
            print_line(
                console,
                f"! {self.urdf}: its masses have the body {100.0 * off_middle:.0f} cm off the middle of a symmetric robot: check its "
                "<inertial> (axes swapped?), or weigh it; +- of y is as large.",
            )
        require_support(estimate.position, g.wheelbase_m, g.track_width_m)
        numbers = self._numbers(robot, estimate, weighed, static, source)
        _print(console, robot, estimate, weighed, static, numbers)
        if self.json is not None:
            write_json(self.json, numbers)

    def _with_arms(self, robot: Robot, weighed: WeighedCg | None) -> tuple[CgEstimate, StaticPart | None, list[str]]:
        arms, folder = robot.arms, robot.folder
        if self.urdf is not None:
            arms, folder = Arms(urdf=str(self.urdf), base_link=self.base_link), Path()
        if arms is None:
            raise CgError(f"robot '{robot.name}' has no arms; name a URDF with --urdf, or give its file a section [arms].")
        postures = self._postures(arms, folder)
        payload, steps = self._payload(), []
        model = arms_model(arms, folder, payload)
        static = None
        if weighed is not None:
            if not self.weighed_posture:
                raise CgError("to move the arms after a weighing, name their posture on the scales: --weighed-posture NAME.")
            chain = arms_model(arms, folder).chain
            static = static_part_from_weighing(weighed, chain, _named(postures, self.weighed_posture))
            model = arms_model(arms, folder, payload, static)
            steps.append(f"the arms of {Path(chain.source).name} off at '{self.weighed_posture}'")
        at: dict[str, float] = dict(_named(postures, self.posture)) if self.posture else {}
        at |= self._joints(model.chain.joint_names)
        estimate = model.estimate(model.chain.posture({name: q for name, q in at.items() if name in model.chain.joint_names}))
        if self.posture or self.joint:
            steps.append("arms at " + " with ".join([*([f"'{self.posture}'"] if self.posture else []), *self.joint]))
        if payload is not None:
            steps.append(f"{payload.mass:g} kg at {payload.link}")
        return estimate, static, steps or [f"the masses of {Path(model.chain.source).name}"]

    def _postures(self, arms: Arms, folder: Path | None) -> dict[str, Posture]:
        if self.srdf is not None:
            try:
                return dict(parse_postures(read_text(self.srdf), str(self.srdf)))
            except (OSError, UnicodeDecodeError) as error:
                raise CgError(f"SRDF '{self.srdf}' cannot be read: {error}.") from error
        return dict(arms_postures(arms, folder))

    def _joints(self, movable: tuple[str, ...]) -> dict[str, float]:
        found = {}
        for text in self.joint:
            name, _, value = text.partition("=")
            try:
                found[name.strip()] = float(value)
            except ValueError:
                found[name.strip()] = math.nan
            if not math.isfinite(found[name.strip()]):
                raise CgError(f"--joint {text}: must be NAME=VALUE with a number [rad or m].")
        unknown = sorted(set(found) - set(movable))
        if unknown:
            raise CgError(f"no joint {', '.join(unknown)} that moves mass; such joints are {', '.join(movable) or 'none'}.")
        return found

    def _payload(self) -> Payload | None:
        if not self.payload and not self.at:
            return None
        if not self.at:
            raise CgError(f"--payload {self.payload:g} takes --at LINK, the link that holds it.")
        return Payload(self.at, self.payload, self.offset, self.payload_sigma)

    def _numbers(
        self, robot: Robot, estimate: CgEstimate, weighed: WeighedCg | None, static: StaticPart | None, source: list[str]
    ) -> dict[str, Any]:
        g, cg = robot.geometry, estimate.position
        sigma = np.sqrt(np.diagonal(estimate.covariance))
        numbers: dict[str, Any] = {
            "robot": robot.name,
            "source": source,
            "mass_kg": estimate.mass,
            "cg_m": cg.tolist(),
            "sigma_m": sigma.tolist(),
            "covariance_m2": estimate.covariance.tolist(),
            "margin_m": estimate.margin(g.wheelbase_m, g.track_width_m),
            "tipping_slope_deg": math.degrees(math.atan2(estimate.margin(g.wheelbase_m, g.track_width_m), g.cg_height_m)),
            "wheel_loads_kg": wheel_loads(robot, estimate),
            "skid_steer": effect(robot, estimate),
        }
        if weighed is not None and self.weighings is not None:
            readings = read_weighings(self.weighings).mean(axis=0)
            numbers["weighed_loads_kg"] = dict(zip(WHEELS, readings.tolist(), strict=True))
            numbers["warp"] = float(readings @ [1.0, -1.0, -1.0, 1.0] / readings.sum())
        if static is not None:
            numbers["static_part"] = {
                "mass_kg": static.mass,
                "position_m": static.position.tolist(),
                "covariance": static.covariance.tolist(),
            }
        return numbers


def wheel_loads(robot: Robot, estimate: CgEstimate) -> dict[str, float]:
    """What each wheel carries [kg] on equally stiff wheels, with the chassis' warp by the robot's friction model."""
    g = robot.geometry
    warp = float(FrictionModel.from_robot(robot).nominal[FrictionModel.param_names.index("warp")])
    x, y = estimate.position / np.array([g.wheelbase_m / 2.0, g.track_width_m / 2.0])
    return dict(zip(WHEELS, (estimate.mass * share for share in loads(float(x), float(y), warp)[:4]), strict=True))


def effect(robot: Robot, estimate: CgEstimate) -> dict[str, dict[str, float]]:
    """k and centre of rotation by the robot's skid_steer model (Ebersole 2016, 4.21-4.25): at the nominal CG, here, and the sigma that the
    CG's covariance alone gives them."""
    model = SkidSteer.from_robot(robot)
    here = np.array(model.rotation(estimate.position, model.nominal))
    nominal = np.array(model.rotation(robot.center_of_gravity, model.nominal))
    J = model.rotation_by_cg(estimate.position, model.nominal)
    sigma = np.sqrt(np.diagonal(J @ estimate.covariance @ J.T))
    names = ("k", "x_cr_m", "y_cr_m")
    return {n: {"nominal": float(a), "here": float(b), "sigma": float(s)} for n, a, b, s in zip(names, nominal, here, sigma, strict=True)}


def _off_middle(urdf: Path, base_link: str) -> float:
    """By how much the masses of a URDF are beside the middle of its symmetric wheels [m]; 0 where they are not, or wheels are not known."""
    try:
        return wheel_geometry(read_text(urdf), str(urdf), base_link).cg_off_middle_m
    except RobotError:
        return 0.0


def _named(postures: dict[str, Posture], name: str) -> Posture:
    if name not in postures:
        raise CgError(no_such("posture", name, [*postures]))
    return postures[name]


def _print(
    console: Console, robot: Robot, estimate: CgEstimate, weighed: WeighedCg | None, static: StaticPart | None, numbers: dict[str, Any]
) -> None:
    (x, y), (sx, sy) = estimate.position, numbers["sigma_m"]
    print_line(console, f"{robot.name}, by {', '.join(numbers['source'])}: {estimate.mass:.2f} kg")
    print_line(console, f"centre of gravity: x {x:+.4f} +- {sx:.4f} m, y {y:+.4f} +- {sy:.4f} m")
    margin = numbers["margin_m"]
    across = sx if robot.geometry.wheelbase_m / 2.0 - abs(x) == margin else sy
    print_line(
        console,
        f"tipping margin: {margin:.3f} m ({margin / max(across, 1e-9):.0f} sigma), a slope of {numbers['tipping_slope_deg']:.0f} deg",
    )
    if weighed is not None and weighed.scatter > 1.5:
        print_line(
            console, f"The weighings differ {weighed.scatter:.1f} times more than scales of 0.1 kg should: lift the robot off between them."
        )
    if static is not None:
        mass, (at_x, at_y), s = static.mass, static.position, np.sqrt(np.diagonal(static.covariance))
        print_line(console, "static part, for [arms] of the robot file:")
        print_line(console, f"  static_mass_kg = {mass:.3f}  # +- {s[0]:.2g}")
        print_line(console, f"  static_x_m = {at_x:.5f}  # +- {s[1]:.2g}")
        print_line(console, f"  static_y_m = {at_y:.5f}  # +- {s[2]:.2g}")
    table = plain_table("load [kg]", *(wheel.replace("_", " ") for wheel in WHEELS), title="")
    add_row(table, "equally stiff wheels", *(f"{load:.2f}" for load in numbers["wheel_loads_kg"].values()))
    if "weighed_loads_kg" in numbers:
        add_row(table, "on the scales", *(f"{load:.2f}" for load in numbers["weighed_loads_kg"].values()))
    print_table(console, table)
    if "warp" in numbers:
        print_line(
            console, f"A twisted chassis puts {numbers['warp']:+.3f} of m g / 4 on the front left and rear right wheels (friction's warp)."
        )
    own = "k_0" in robot.models.get("skid_steer", {})
    title = "\nskid_steer (4.21-4.25)" + ("" if own else ", from the robot's geometry by the friction model: the robot file has no k_0")
    what = plain_table("", f"nominal ({robot.geometry.cg_x_m:g}, {robot.geometry.cg_y_m:g}) m", "here", "sigma by the CG", title=title)
    for name, value in numbers["skid_steer"].items():
        add_row(what, name.replace("_m", " [m]"), f"{value['nominal']:+.4f}", f"{value['here']:+.4f}", f"{value['sigma']:.4f}")
    print_table(console, what)
