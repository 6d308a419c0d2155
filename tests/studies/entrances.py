"""Wirings, units, clocks, topics, descriptions and references as practitioners bring them, on robots of many sizes.

`python -m tests.studies.entrances [developed | held_out | unseen | healthy] [KIND ...]` prints kind, variant and outcome:

- right: what the log should have been read as, and (but for healthy ones) a sentence or a table that names what was found
- named: not corrected, but a sentence names it
- misnamed: a sentence names something else
- silent: wrong without a word
"""

from __future__ import annotations

import math
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from motion_models.errors import SkidlocError
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.bags import START, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, drive, write

AS_THEY_ARE = Publishing()
Outcome = Literal["right", "named", "misnamed", "silent"]


@dataclass(frozen=True)
class Found:
    """Outcome of one variant, and the sentences."""

    outcome: Outcome
    text: str


@dataclass(frozen=True)
class Variant:
    """One input, and how it is judged in a folder."""

    kind: str
    name: str
    judge: Callable[[Path], Found]


def choose_outcome(is_right: bool, is_named: bool, is_warned: bool, words: Sequence[str]) -> Outcome:
    """``words`` name what is wrong with the input, if anything is; ``is_named``: they are in the sentences, or there is none to be."""
    if is_named and (is_right or words):
        return "right" if is_right else "named"
    return "misnamed" if is_warned else "silent"


# wheels and gyro


def wired(
    name: str,
    vehicle: Vehicle,
    how: Publishing,
    words: Sequence[str],
    robot: Callable[[Robot], Robot] = lambda r: r,
    kind: str = "wiring",
    is_undecidable: bool = False,
) -> Variant:
    """Wheels or a gyro as drivers wire them: right where the replay is as good as with nothing wrong.

    ``is_undecidable``: nothing in the log decides, so that to name all ways and to correct none is right.
    """

    def judge(folder: Path) -> Found:
        from tests.studies.entrance_commands import driven

        found = driven(kind, name, vehicle, how, words, robot=robot).judge(folder)
        if kind == "healthy" and "!" in found.text:
            return Found("misnamed", found.text)
        return Found("right", found.text) if is_undecidable and found.outcome == "named" else found

    return Variant(kind, name, judge)


def scaled(angle: float, rate: float) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities times these; an empty list for 0."""
    return lambda a, r: (a * angle if angle else np.zeros(0), r * rate if rate else np.zeros(0))


def signed(*signs: float) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities with these signs: front left, rear left, front right, rear right."""
    return lambda a, r: (a * np.array(signs[: len(a)]), r * np.array(signs[: len(r)]))


def reordered(*order: int) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Wheels that publish under the names of others."""
    return lambda a, r: (a[list(order)], r[list(order)])


def counted(ticks_per_turn: float, bits: int = 0, rates: float = 0.0) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Whole ticks, wrapped to ``bits`` if any (signed)."""

    def change(a: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ticks = np.round(a * ticks_per_turn / math.tau)
        if bits:
            ticks = (ticks + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
        return ticks, r * rates if rates else np.zeros(0)

    return change


# clocks and first messages


def clocked(name: str, vehicle: Vehicle, how: Publishing, topic: str, words: Sequence[str]) -> Variant:
    """A topic with old messages or another clock."""
    return wired(name, vehicle, how, words, kind="clocks")


# mounts


def mounted(name: str, vehicle: Vehicle, how: Publishing, words: Sequence[str]) -> Variant:
    """A LiDAR whose mount is not that of /tf_static."""
    return wired(name, vehicle, how, words, kind="mounts")


# point times


def pointed(
    name: str,
    vehicle: Vehicle,
    field_name: str,
    dtype: str,
    times: Callable[[np.ndarray, float, int], np.ndarray],
    words: Sequence[str],
) -> Variant:
    """Clouds whose points have ``times`` of parts of the sweep (n,), its period [s] and its stamp [ns]: right where they are read to 1 ms.

    With ``words``, times mean nothing, and that is named.
    """

    def judge(folder: Path) -> Found:
        from tests.studies.entrance_commands import clouded

        return clouded(name, vehicle, field_name, dtype, times, words).judge(folder)

    return Variant("point times", name, judge)


# references


def referenced(
    name: str,
    vehicle: Vehicle,
    content: Callable[[Motion], str],
    words: Sequence[str],
    suffix: str = "tum",
    noise: float = 0.0,
) -> Variant:
    """A reference file: right where its poses are read as the true ones, or what is wrong with it is named."""

    def judge(folder: Path) -> Found:
        from tests.studies.entrance_commands import scored

        return scored(name, vehicle, content, suffix, words, noise).judge(folder)

    return Variant("references", name, judge)


def tum(
    motion: Motion, scale: float = 1.0, offset_s: float = 0.0, hz: int = 10, swap: str = "", noise: float = 0.0, comma: str = " "
) -> str:
    """The truth as TUM; ``swap``: "ned" (x north, y east), "y" (inverted), "yaw" (clockwise headings)."""
    rng = np.random.default_rng(3)
    lines = []
    for i in range(0, len(motion.t), round(100 / hz)):
        x, y, yaw = motion.poses[i]
        x, y = x + noise * rng.normal(), y + noise * rng.normal()
        if swap == "ned":
            x, y, yaw = y, x, math.pi / 2 - yaw
        elif swap == "y":
            y, yaw = -y, -yaw
        elif swap == "yaw":
            yaw = -yaw
        stamp = f"{START / S + motion.t[i] + offset_s:.4f}"
        numbers = (scale * x + 5.0, scale * y - 3.0, 0.2, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        lines.append(comma.join([stamp, *(f"{n:.6f}" for n in numbers)]))
    return "\n".join(lines) + "\n"


# robot files


def described(
    name: str,
    vehicle: Vehicle,
    urdf: str,
    how: Publishing = AS_THEY_ARE,
    controller: str = "",
    left: Iterable[str] | None = None,
    wanted: Mapping[str, float] | None = None,
    words: Sequence[str] = (),
) -> Variant:
    """A description beside a log: right where sides and lengths are the vehicle's, to 5 %; ``words`` name what contradicts."""

    def judge(folder: Path) -> Found:
        from tests.studies.entrance_commands import run_command

        log = write(folder / "log.mcap", vehicle, drive(vehicle), how)
        options = []
        for option, text, file in (("--urdf", urdf, "robot.urdf"), ("--controller", controller, "control.yaml")):
            if text:
                (folder / file).write_text(text)
                options += [option, str(folder / file)]
        code, text = run_command("init", str(log), *options, "--out", str(folder / "new.toml"))
        flat = " ".join(text.split())
        is_named = all(word in flat for word in words)
        if code or not (folder / "new.toml").exists():
            return Found(choose_outcome(False, is_named, True, words), f"[exit {code}] {text}")
        try:
            robot = load_robot(folder / "new.toml")
        except SkidlocError as error:  # lengths that were asked for are not in it
            return Found("named" if (words and is_named) or not words else "misnamed", f"{error} {text}")
        lengths = {"wheel_radius_m": vehicle.radius, "track_width_m": vehicle.track, "wheelbase_m": vehicle.wheelbase, **(wanted or {})}
        wrong = [n for n, v in lengths.items() if abs(math.log(getattr(robot.geometry, n) / v)) > 0.05]
        is_side_right = {*robot.joints.left} == set(vehicle.left if left is None else left)
        state = f"[left {robot.joints.left}; wrong {wrong}] "
        return Found(choose_outcome(is_side_right and not wrong, is_named or not words, True, words), state + text)

    return Variant("descriptions", name, judge)


def link(name: str, inside: str = "") -> str:
    """A link with a mass."""
    return f'<link name="{name}"><inertial><mass value="1.0"/></inertial>{inside}</link>'


def cylinder(radius: float, length: float = 0.08) -> str:
    """A collision shape whose axis is the joint's y."""
    return f'<collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="{radius}" length="{length}"/></geometry></collision>'


def wheel(
    joint: str, child: str, x: float, y: float, shape: str, axis: str = "0 1 0", parent: str = "base_link", rpy: str = "0 0 0"
) -> str:
    """A wheel."""
    return link(child, shape) + (
        f'<joint name="{joint}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} {y} 0" rpy="{rpy}"/><axis xyz="{axis}"/></joint>'
    )


def urdf_of(
    vehicle: Vehicle,
    names: Sequence[str],
    shape: str | None = None,
    more: str = "",
    children: str = "{}_link",
    base: str = "base_link",
    track: float | None = None,
    **of_wheel: str,
) -> str:
    """A robot of four wheels ``names``: front left, rear left, front right, rear right; or two of one axle."""
    half, track = vehicle.wheelbase / 2.0, vehicle.track if track is None else track
    places = [(half, track / 2), (-half, track / 2), (half, -track / 2), (-half, -track / 2)]
    places = places if len(names) == 4 else [(0.0, track / 2), (0.0, -track / 2)]
    shape = cylinder(vehicle.radius) if shape is None else shape
    wheels = "".join(wheel(n, children.format(n), *p, shape, parent=base, **of_wheel) for n, p in zip(names, places, strict=True))
    return f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{link(base)}{wheels}{more}</robot>'


def run(variants: Iterable[Variant], is_verbose: bool = False) -> list[tuple[Variant, Found]]:
    """Judge all, and print a table."""
    found = []
    for variant in variants:
        with tempfile.TemporaryDirectory() as folder:
            try:
                one = variant.judge(Path(folder))
            except SkidlocError as error:
                one = Found("misnamed", f"ERROR {error}")
            except Exception:
                one = Found("silent", traceback.format_exc())
        found.append((variant, one))
        print(f"{variant.kind:13s} {variant.name:50s} {one.outcome}", flush=True)
        if is_verbose or one.outcome in ("silent", "misnamed"):
            print(f"      {one.text[:900]}", flush=True)
    return found


def print_shares(found: Sequence[tuple[Variant, Found]]) -> None:
    """Share of outcomes by kind."""
    for kind in (*dict.fromkeys(variant.kind for variant, _ in found), ""):
        counts = Counter(one.outcome for variant, one in found if kind in (variant.kind, ""))
        print(f"{kind or 'all':13s} {dict(counts)}, {100.0 * counts['right'] / max(sum(counts.values()), 1):.0f} % right")


def main(arguments: Sequence[str]) -> None:
    """Run the sets and kinds that are named, by default all."""
    from tests.studies.entrance_unseen import UNSEEN
    from tests.studies.entrance_variants import DEVELOPED, HEALTHY, HELD_OUT

    variants = {"developed": DEVELOPED, "healthy": HEALTHY, "held_out": HELD_OUT, "unseen": UNSEEN}

    sets = [name for name in arguments if name in variants] or list(variants)
    kinds = [name for name in arguments if name not in variants and not name.startswith("-")]
    for name in sets:
        print(f"== {name}")
        chosen = [v for v in variants[name] if not kinds or v.kind in kinds or any(k in v.name for k in kinds)]
        print_shares(run(chosen, "-v" in arguments))


if __name__ == "__main__":
    main(sys.argv[1:])
