"""Help of a command, read from its source: importing it for that would take seconds, with numba, GTSAM and all settings."""

from __future__ import annotations

import ast
import textwrap
from dataclasses import dataclass
from importlib.resources import files

_INDENT = 6
_WIDTH = 100


@dataclass(frozen=True)
class Option:
    """One field of a command's dataclass."""

    name: str
    text: str
    default: str
    """Where it is a plain value and worth to be shown."""
    is_required: bool
    is_positional: bool
    is_group: bool
    """Whether it is a dataclass of settings, which only the long help lists."""
    metavar: str
    aliases: tuple[str, ...]
    """Other names of the option."""

    @property
    def flag(self) -> str:
        """The option or positional argument as it is typed."""
        return self.name.upper() if self.is_positional else "--" + self.name.replace("_", "-")


def options_of(command: str, class_name: str) -> list[Option] | None:
    """Options of a command; None where it has subcommands."""
    options = _class(f"localization.commands.{command.replace('-', '_')}", class_name)[1]
    return None if any(option.name == "action" for option in options) else options


def short_help(command: str, class_name: str) -> str | None:
    """Text for ``skidloc command --help``; None where the command has subcommands."""
    found, options = _class(f"localization.commands.{command.replace('-', '_')}", class_name)
    if any(option.name == "action" for option in options):
        return None
    required = [o.flag if o.is_positional else f"{o.flag} {o.metavar}" for o in options if o.is_required]
    lines = [f"usage: skidloc {command} {' '.join(required)} [OPTIONS]", "", ast.get_docstring(found) or "", ""]
    for option in options:
        if option.is_group:
            continue
        lines.append(f"  {option.flag}" + (f" (default: {option.default})" if option.default else ""))
        lines += textwrap.wrap(option.text, _WIDTH - _INDENT, initial_indent=" " * _INDENT, subsequent_indent=" " * _INDENT)
    groups = [option.flag + ".*" for option in options if option.is_group]
    if groups:
        lines += ["", f"{' and '.join(groups)}: settings, each with its default; `skidloc {command} --help-all` lists them."]
    return "\n".join(lines)


def _class(module: str, name: str) -> tuple[ast.ClassDef, list[Option]]:
    """Class ``name`` of ``module``, and its options after those that it inherits."""
    package, *folders, file = module.split(".")
    tree = ast.parse(files(package).joinpath(*folders, f"{file}.py").read_text(encoding="utf-8"))  # no folder's __init__ is run
    found = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    inherited: list[Option] = []
    for base in (base.id for base in reversed(found.bases) if isinstance(base, ast.Name)):  # as dataclasses take fields
        source = next((node for node in tree.body if isinstance(node, ast.ImportFrom) and base in (a.name for a in node.names)), None)
        if source is not None and source.module is not None:
            inherited += _class(source.module, base)[1]
    return found, [*inherited, *_options(found)]


def _options(node: ast.ClassDef) -> list[Option]:
    """Fields of the dataclass with the docstrings below them."""
    found = []
    for field, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            value = field.value
            is_shown = isinstance(value, ast.Constant) and value.value not in (None, False, "")
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found.append(
                Option(
                    field.target.id,
                    " ".join(str(text).split()),
                    str(ast.literal_eval(value)) if is_shown and value is not None else "",
                    value is None,
                    "Positional" in ast.unparse(field.annotation),
                    value is not None and "default_factory" in ast.unparse(value),
                    *_of_annotation(field.annotation, field.target.id),
                )
            )
    return found


def _of_annotation(annotation: ast.expr, name: str) -> tuple[str, tuple[str, ...]]:
    """Placeholder of the value and aliases of an option, as `tyro.conf.arg` has them."""
    given = {
        k.arg: ast.literal_eval(k.value)
        for node in ast.walk(annotation)
        if isinstance(node, ast.Call)
        for k in node.keywords
        if k.arg != "help"
    }
    return str(given.get("metavar", name.upper())), tuple(given.get("aliases", ()))
