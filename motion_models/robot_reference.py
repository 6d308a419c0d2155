"""Reference of every key of robot files, generated from the dataclasses that read them.

python -m motion_models.robot_reference > motion_models/robots/README.md
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from typing import Any

from motion_models.calibration.plan import MEANING
from motion_models.center_of_gravity.parts import Arms
from motion_models.registry import MODELS
from motion_models.robot import DRIVES, MODEL_OPTIONS, Driver, Geometry, GyroNoise, Joints, Mount, Robot, Topics, WheelNoise

_SECTIONS: tuple[tuple[str, type[Any]], ...] = (
    ("geometry", Geometry),
    ("driver", Driver),
    ("topics", Topics),
    ("joints", Joints),
    ("mounts.FRAME", Mount),
    ("wheel_noise", WheelNoise),
    ("gyro_noise", GyroNoise),
    ("arms", Arms),
)
_HEAD = """# Robot files

One TOML file describes a robot. The files of this folder are robots that are shipped (`skidloc robots`); the numbers of each have their
source beside them. `skidloc init LOG --out ROBOT.toml` writes one for another robot, and every command takes its path as `--robot`.
Lengths are in metres, angles in radians, masses in kilograms; unknown keys are refused.

This page is generated from the dataclasses (`python -m motion_models.robot_reference`), and a test compares both.
"""


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
        lines += [f"| `{key}` | {MEANING.get(key, '')} |" for key in _parameters(model)]
        lines += [f"| `{key}` | choice, see `motion_models.{name}` |" for key in MODEL_OPTIONS.get(name, ())]
    return "\n".join(lines) + "\n"


def _parameters(model: type[Any]) -> tuple[str, ...]:
    return tuple(model.param_names)


def _header() -> list[str]:
    return ["| key | type | default | meaning |", "|---|---|---|---|"]


def _row(key: str, kind: str, default: str, text: str) -> str:
    return f"| `{key}` | {kind} | {default} | {text.replace('|', '/')} |"


def _kind_of(declared: str) -> str:
    return {"float": "number", "str": "text"}.get(declared, "list of texts")


def _default_of(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "needed"
    if isinstance(field.default, tuple):
        return ", ".join(f'"{value}"' for value in field.default) or "none"
    return f'"{field.default}"' if isinstance(field.default, str) else f"{field.default:g}"


if __name__ == "__main__":
    print(reference(), end="")
