"""URDFs of robots of `tests.helpers.entrance_drives`, as text."""

from __future__ import annotations

from collections.abc import Sequence

from tests.helpers.entrance_drives import Vehicle


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
