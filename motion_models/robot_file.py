"""Robot files (TOML): how a robot is read from one and written as one, and the reference of all their keys.

python -m motion_models.robot_file > motion_models/robots/README.md
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import json
import os
import re
import textwrap
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from motion_models.center_of_gravity.parts import Arms
from motion_models.errors import RobotError
from motion_models.input_files import read_text
from motion_models.registry import MODELS, params_of, traits_of
from motion_models.robot import DRIVES, Clock, Driver, Geometry, GyroNoise, Imu, Joints, Lidar, Mount, Robot, Tf, Topics, WheelNoise
from motion_models.robot_names import check_robot_name
from motion_models.terms import VARIABLES, parse_terms, terms_table

Section = TypeVar("Section")

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_LARGEST = 1e9
"""Largest number of a robot, in SI units; the largest that robots have are stiffnesses and inertias of 1e6."""
_LONGEST_M = 100.0
"""Largest length of a robot [m]; the largest mining vehicles have 20."""
_MOST_CHARACTERS = 1 << 20
"""Most characters of a robot file; the longest that is shipped has 1,200."""
_MOST_DOTS = 200
"""In one line of a robot file: the names of a dozen wheels with their namespaces have fewer."""
_LARGEST_CLOCK_OFFSET_S = 10.0
"""Beyond it clocks are not synchronized, and no offset is constant [s]."""
_LONGEST_SHOWN = 60  # characters of what a user wrote, in a message

_SECTIONS: tuple[tuple[str, type[Any]], ...] = (
    ("geometry", Geometry),
    ("driver", Driver),
    ("topics", Topics),
    ("joints", Joints),
    ("imu", Imu),
    ("lidar", Lidar),
    ("tf", Tf),
    ("mounts.FRAME", Mount),
    ("wheel_noise", WheelNoise),
    ("gyro_noise", GyroNoise),
    ("clock", Clock),
    ("arms", Arms),
)
_HEAD = """# Robot files

One TOML file describes a robot. The files of this folder are robots that are shipped (`skidloc robots`); the numbers of each have their
source beside them. `skidloc init LOG --out ROBOT.toml` writes one for another robot, and every command takes its path as `--robot`.
Lengths are in metres, angles in radians, masses in kilograms; unknown keys are refused.

This page is generated from the dataclasses (`python -m motion_models.robot_file`), and a test compares both.
"""

_TERMS = "terms"
"""Table of a model's learned terms, among its coefficients."""
_TERMS_TEXT = (
    "Learned terms, which are added to the twist of any model: a table for each of vx, vy and wz, by products of variables, each as it is, "
    'to a power (`v^2`), or in `abs()` or `sign()`: `vy = {"wz*abs(wz)" = [-0.12, 0.01, "m s"]}` is value, standard deviation (with which '
    "it is corrected online; 0 or none: it stays) and unit (may be left out). `skidloc diagnose --extend` finds them."
)


def load_robot(robot: str | Path) -> Robot:
    """The robot of a shipped name (`robot_names`) or of a path to a TOML file. Raises `RobotError`.

    >>> robot = load_robot("vaultbot")
    >>> robot.geometry.track_width_m, robot.driver.wheel_separation_multiplier
    (0.56, 1.875)
    """
    path = Path(robot)
    if path.suffix == ".toml":
        try:
            text = read_text(path)
        except OSError as error:
            raise RobotError(f"robot file '{path}' cannot be read: {error.strerror}.") from error
        except UnicodeDecodeError as error:
            raise RobotError(f"robot file '{path}' is not text (byte {error.start} is not UTF-8).") from error
        return parse_robot(text, source=str(path), folder=path.parent.absolute())
    check_robot_name(str(robot))
    text = (resources.files(__package__) / "robots" / f"{robot}.toml").read_text(encoding="utf-8")
    return parse_robot(text, source=f"{robot}.toml")


def parse_robot(text: str, source: str, folder: Path | None = None) -> Robot:
    """The robot of a TOML text; ``source`` names it in errors, ``folder`` is where paths in it start. Raises `RobotError`."""
    _refuse_long_keys(text, source)
    try:
        data = tomllib.loads(text)
    except ValueError as error:  # what the parser raises, and for a number of thousands of digits
        raise RobotError(f"{source}: not valid TOML: {error}.") from error
    except RecursionError as error:
        raise RobotError(f"{source}: not valid TOML: its brackets are nested too deeply.") from error
    known = {f.name for f in dataclasses.fields(Robot)} - {"folder", "options", "terms"}
    _refuse_unknown(data, known, source)
    if not isinstance(data.get("name"), str):
        raise RobotError(f'{source}: needs a line name = "...".')
    drive = data.get("drive", DRIVES[0])
    if drive not in DRIVES:
        raise RobotError(f"{source}: drive is {drive!r}; there are {', '.join(DRIVES)}.")
    geometry = _section(Geometry, data, "geometry", source)
    for name in ("wheel_radius_m", "track_width_m", "wheelbase_m", "mass_kg"):
        if not getattr(geometry, name) > 0:
            raise RobotError(f"{source}: geometry.{name} is {getattr(geometry, name)}; it must be positive.")
    for name in ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier"):
        if not 0.1 < getattr(geometry, name) < 10.0:
            raise RobotError(f"{source}: geometry.{name} is {getattr(geometry, name)}; it must be near 1.")
    if not 1e-4 <= geometry.wheel_deflection <= 0.5:
        raise RobotError(f"{source}: geometry.wheel_deflection is {geometry.wheel_deflection}; it must be 0.0001 to 0.5.")
    for name, value in dataclasses.asdict(geometry).items():
        if name.endswith("_m") and abs(value) > _LONGEST_M:
            raise RobotError(f"{source}: geometry.{name} is {value:g}; it must be in metres, and at most {_LONGEST_M:g}.")
    driver = _section(Driver, data, "driver", source) if "driver" in data else Driver(geometry.wheel_radius_m, geometry.track_width_m)
    if min(dataclasses.astuple(driver)) <= 0:
        raise RobotError(f"{source}: every number of [driver] must be positive.")
    mounts = {frame: _build(Mount, table, f"mounts.{frame}", source) for frame, table in _table_of(data, "mounts", source).items()}
    tables = _table_of(data, "models", source)
    models, options = _models(tables, source)
    return Robot(
        name=data["name"],
        geometry=geometry,
        driver=driver,
        drive=drive,
        topics=_section(Topics, data, "topics", source),
        joints=_joints(data, source),
        imu=_imu(data, source),
        lidar=_lidar(data, source),
        tf=_tf(data, set(mounts), source),
        mounts=mounts,
        wheel_noise=_noise(WheelNoise, data, "wheel_noise", source),
        gyro_noise=_noise(GyroNoise, data, "gyro_noise", source),
        clock=_clock(data, source),
        models=models,
        options=options,
        terms={name: found for name, t in tables.items() if (found := parse_terms(t.get(_TERMS, {}), f"{source}, [models.{name}.terms]"))},
        arms=_arms(data, source) if "arms" in data else None,
        folder=folder,
    )


def _refuse_long_keys(text: str, source: str) -> None:
    """Raises `RobotError` for lines with so many dots that they can only be a key of as many parts, or a file too long for a robot's.

    The parser stores each beginning of a dotted key: a key of 20,000 parts takes 2.5 GB.
    """
    if len(text) > _MOST_CHARACTERS:
        raise RobotError(f"{source}: has {len(text)} characters; a robot file has at most {_MOST_CHARACTERS}.")
    for number, line in enumerate(text.splitlines(), 1):
        dots = line.count(".")
        if dots > _MOST_DOTS and not line.lstrip().startswith("#"):
            raise RobotError(f"{source}: line {number} has {dots} dots; names of robot files have at most three.")


def _joints(data: Mapping[str, Any], source: str) -> Joints:
    joints = _section(Joints, data, "joints", source)
    if shared := sorted(set(joints.left) & set(joints.right)):
        raise RobotError(f"{source}: joints.left and joints.right both hold {', '.join(shared)}; a wheel is on one side.")
    unknown = sorted({*joints.reversed} - {*joints.left, *joints.right})
    if unknown:
        raise RobotError(f"{source}: joints.reversed names {', '.join(unknown)}, which is neither in joints.left nor in joints.right.")
    if min(joints.angle_unit_rad, joints.rate_unit_rad_s) <= 0.0 or joints.angle_range < 0.0:
        raise RobotError(f"{source}: units of [joints] must be positive; wheels that count backwards are named in joints.reversed.")
    return joints


def _imu(data: Mapping[str, Any], source: str) -> Imu:
    imu = _section(Imu, data, "imu", source)
    if imu.rate_unit_rad_s == 0.0:
        raise RobotError(f"{source}: imu.rate_unit_rad_s is 0; it is 1 for rad/s and 0.0174533 for degrees per second.")
    return imu


def _lidar(data: Mapping[str, Any], source: str) -> Lidar:
    lidar = _section(Lidar, data, "lidar", source)
    if not 0.5 <= lidar.range_scale <= 2.0:
        raise RobotError(f"{source}: lidar.range_scale is {lidar.range_scale:g}; it must be near 1: measured ranges over the true ones.")
    if abs(lidar.range_offset_m) > 1.0:
        raise RobotError(f"{source}: lidar.range_offset_m is {lidar.range_offset_m:g} m; it must be at most 1.")
    return lidar


def _tf(data: Mapping[str, Any], mounted: set[str], source: str) -> Tf:
    tf = _section(Tf, data, "tf", source)
    if absent := [frame for frame in tf.overridden if frame not in mounted]:
        raise RobotError(f"{source}: tf.overridden names {', '.join(absent)}, of which there is no [mounts.{absent[0]}].")
    return tf


def _clock(data: Mapping[str, Any], source: str) -> Clock:
    clock = _section(Clock, data, "clock", source)
    for entry, value in dataclasses.asdict(clock).items():
        if abs(value) > _LARGEST_CLOCK_OFFSET_S:
            raise RobotError(
                f"{source}: clock.{entry} is {value:g} s; it must be at most {_LARGEST_CLOCK_OFFSET_S:g}. Synchronize the clocks."
            )
    if clock.sigma_s < 0.0:
        raise RobotError(f"{source}: clock.sigma_s is {clock.sigma_s:g} s; it must be at least 0.")
    return clock


def _noise(kind: type[Section], data: Mapping[str, Any], name: str, source: str) -> Section:
    noise = _section(kind, data, name, source)
    for entry, value in dataclasses.asdict(noise).items():  # type: ignore[call-overload]
        if value < 0.0:
            raise RobotError(f"{source}: {name}.{entry} is {value:g}; it must not be below 0.")
    return noise


def _models(tables: Mapping[str, Any], source: str) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, str | bool]]]:
    """Coefficients and choices of each model."""
    _refuse_unknown(tables, set(MODELS), f"{source}, [models]")
    models: dict[str, dict[str, float]] = {}
    options: dict[str, dict[str, str | bool]] = {}
    for model in tables:
        table, choices = _table_of(tables, model, source), traits_of(model).options
        _refuse_unknown(table, {*(p.name for p in params_of(model)), *choices, _TERMS}, f"{source}, [models.{model}]")
        models[model] = {
            name: _number(value, f"models.{model}.{name}", source) for name, value in table.items() if name not in (*choices, _TERMS)
        }
        for name in table.keys() & choices:
            if not isinstance(table[name], str | bool):
                raise RobotError(f"{source}: models.{model}.{name} must be text or true or false, found {table[name]!r}.")
            options.setdefault(model, {})[name] = table[name]
    return models, options


def _arms(data: Mapping[str, Any], source: str) -> Arms:
    arms = _section(Arms, data, "arms", source)
    for name, value in dataclasses.asdict(arms).items():
        if ("sigma" in name or name in ("static_mass_kg", "payload_kg")) and value < 0.0:
            raise RobotError(f"{source}: arms.{name} is {value:g}; it must not be below 0.")
    if arms.payload_kg > 0.0 and not arms.payload_link:
        raise RobotError(f"{source}: arms.payload_kg is {arms.payload_kg:g}, but arms.payload_link names no link that holds it.")
    if arms.weighed_posture and not arms.postures:
        raise RobotError(f"{source}: arms.weighed_posture names '{arms.weighed_posture}', but arms.postures names no SRDF that has it.")
    return arms


def _table_of(data: Mapping[str, Any], name: str, source: str) -> Mapping[str, Any]:
    table = data.get(name, {})
    if not isinstance(table, Mapping):
        raise RobotError(f"{source}: '{name}' must be a table ([{name}]), found {table!r}.")
    return table


def _section(kind: type[Section], data: Mapping[str, Any], name: str, source: str) -> Section:
    return _build(kind, _table_of(data, name, source), name, source)


def _build(kind: type[Section], table: Any, name: str, source: str) -> Section:
    if not isinstance(table, Mapping):
        raise RobotError(f"{source}: '{name}' must be a table, found {table!r}.")
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    _refuse_unknown(table, set(fields), f"{source}, [{name}]")
    values: dict[str, Any] = {}
    for key, value in table.items():
        declared = str(fields[key].type)
        if declared == "float":
            values[key] = _number(value, f"{name}.{key}", source)
        elif declared == "str":
            if not isinstance(value, str):
                raise RobotError(f"{source}: {name}.{key} must be text, found {value!r}.")
            values[key] = value
        elif declared == "bool":
            if not isinstance(value, bool):
                raise RobotError(f"{source}: {name}.{key} must be true or false, found {value!r}.")
            values[key] = value
        else:
            if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
                raise RobotError(f"{source}: {name}.{key} must be a list of names, found {value!r}.")
            values[key] = tuple(value)
    missing = [
        f.name
        for f in fields.values()
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING and f.name not in values
    ]
    if missing:
        raise RobotError(f"{source}: [{name}] has no {', '.join(missing)}.")
    return kind(**values)


def _refuse_unknown(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        nearest = difflib.get_close_matches(unknown[0][:_LONGEST_SHOWN], sorted(known), n=1)
        meant = f" (did you mean {nearest[0]}?)" if nearest else ""
        named = ", ".join(name if len(name) <= _LONGEST_SHOWN else f"{name[:_LONGEST_SHOWN]}..." for name in unknown[:10])
        raise RobotError(f"{where}: unknown entry {named}{meant}; known are {', '.join(sorted(known))}.")


def _number(value: Any, name: str, source: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not -_LARGEST <= value <= _LARGEST:  # false for NaN
        found = repr(value) if not isinstance(value, int) or abs(value) < 10**20 else "an integer of more than 20 digits"
        raise RobotError(f"{source}: {name} must be a finite number of at most {_LARGEST:g}, found {found[:_LONGEST_SHOWN]}.")
    return float(value)


def robot_toml(robot: Robot, sigmas: Mapping[str, Mapping[str, float]] | None = None, remarks: str = "") -> str:
    """``robot`` as TOML, without entries that are the defaults; `parse_robot` of it is equal to ``robot``.

    ``sigmas``: model -> parameter -> standard deviation, written as a comment beside the value. ``remarks`` (any number of lines)
    come first, as comments: what it was calibrated on.
    """
    sigmas = sigmas or {}
    lines = [f"# {line}".rstrip() for line in remarks.splitlines()]
    lines.append(f"name = {_value(robot.name)}")
    if robot.drive != Robot.drive:
        lines.append(f"drive = {_value(robot.drive)}")
    for name in ("geometry", "driver"):
        lines += _table(name, _not_default(getattr(robot, name)))
    for name in ("topics", "joints", "imu", "lidar", "tf", "wheel_noise", "gyro_noise", "clock"):
        entries = _not_default(getattr(robot, name))
        lines += _table(name, entries) if entries else []
    if robot.arms is not None:
        lines += _table("arms", {name: value for name, value in dataclasses.asdict(robot.arms).items() if value != ()})
    for frame, mount in robot.mounts.items():
        lines += _table(f"mounts.{_key(frame)}", _not_default(mount))
    for model in dict.fromkeys([*robot.models, *robot.options, *robot.terms]):
        entries = {**robot.options.get(model, {}), **robot.models.get(model, {})}
        lines += _table(f"models.{_key(model)}", entries, sigmas.get(model, {})) if entries or model not in robot.terms else []
        if robot.terms.get(model):
            lines += ["", f"[models.{_key(model)}.{_TERMS}]", *terms_table(robot.terms[model])]
    return "\n".join(lines) + "\n"


def relocated(robot: Robot, folder: Path) -> Robot:
    """``robot`` as a file in ``folder`` has it: the paths in it start there. Those of shipped robots hold everywhere."""
    if robot.arms is None or robot.folder is None:
        return dataclasses.replace(robot, folder=folder)
    start, names = robot.folder, (robot.arms.urdf, robot.arms.postures)
    urdf, postures = (os.path.relpath(start / name, folder) if name and (start / name).exists() else name for name in names)
    return dataclasses.replace(robot, arms=dataclasses.replace(robot.arms, urdf=urdf, postures=postures), folder=folder)


def _not_default(section: Any) -> dict[str, Any]:
    """Entries of a ``section`` of a robot that differ from what they are where the file leaves them out."""
    return {f.name: value for f in dataclasses.fields(section) if (value := getattr(section, f.name)) != f.default}


def _table(header: str, values: Mapping[str, Any], sigmas: Mapping[str, float] | None = None) -> list[str]:
    lines = ["", f"[{header}]"]
    for name, value in values.items():
        sigma = (sigmas or {}).get(name)
        remark = "" if sigma is None else f"  # +- {sigma:.2g}"
        lines.append(f"{_key(name)} = {_value(value)}{remark}")
    return lines


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _text(name)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    return repr(float(value))


def _text(value: str) -> str:
    # JSON's strings are TOML's, but for the one control character that JSON leaves alone.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def field_texts(kind: type[Any]) -> dict[str, str]:
    """Docstring of each field of a dataclass: the string below it in the source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for statement, following in zip(body.body, body.body[1:], strict=False):
        text = following.value.value if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant) else None
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and isinstance(text, str):
            found[statement.target.id] = " ".join(text.split())
    return found


def reference() -> str:
    """The page, in Markdown."""
    own = field_texts(Robot)
    lines = [_HEAD, "## Top level", "", *_header()]
    lines += [_row("name", "text", "needed", "Name of the robot.")]
    lines += [_row("drive", "text", f'"{Robot.drive}"', f"{own['drive']} One of {', '.join(DRIVES)}.")]
    for name, kind in _SECTIONS:
        texts = field_texts(kind)
        lines += ["", f"## [{name}]", "", " ".join((inspect.getdoc(kind) or "").split()), "", *_header()]
        for f in dataclasses.fields(kind):
            lines.append(_row(f.name, _kind_of(str(f.type)), _default_of(f), texts.get(f.name, "")))
    lines += ["", "## [models.NAME]", "", "Coefficients of a motion model. What is left out follows the robot's geometry or driver."]
    for name, model in MODELS.items():
        doc = (inspect.getdoc(model) or "").split("\n", 1)[0]
        lines += ["", f"### [models.{name}]", "", doc, "", "| key | meaning |", "|---|---|"]
        lines += [f"| `{p.name}` | {p.text} |" for p in params_of(name)]
        lines += [f"| `{key}` | choice, see `motion_models.{name}` |" for key in traits_of(name).options]
    lines += ["", f"### [models.NAME.{_TERMS}]", "", _TERMS_TEXT, "", "| variable | meaning |", "|---|---|"]
    lines += [f"| `{name}` | {variable.meaning} |" for name, variable in VARIABLES.items()]
    return "\n".join(lines) + "\n"


def _header() -> list[str]:
    return ["| key | type | default | meaning |", "|---|---|---|---|"]


def _row(key: str, kind: str, default: str, text: str) -> str:
    return f"| `{key}` | {kind} | {default} | {text.replace('|', '/')} |"


def _kind_of(declared: str) -> str:
    return {"float": "number", "str": "text", "bool": "true or false"}.get(declared, "list of texts")


def _default_of(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "needed"
    if isinstance(field.default, bool):
        return str(field.default).lower()
    if isinstance(field.default, tuple):
        return ", ".join(f'"{value}"' for value in field.default) or "none"
    return f'"{field.default}"' if isinstance(field.default, str) else f"{field.default:g}"


if __name__ == "__main__":
    print(reference(), end="")
