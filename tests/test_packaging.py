"""Container, devcontainer and conda recipe agree with pyproject.toml."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from ruamel.yaml import YAML

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_conda_recipe_has_the_dependencies_and_commands_of_the_wheel() -> None:
    recipe = YAML(typ="safe").load((ROOT / "conda/recipe.yaml").read_text(encoding="utf-8"))
    wheel = {re.sub(r"[<>=].*", "", need.split(";")[0]): need.split(";")[0] for need in PROJECT["dependencies"]}
    conda = {need.split()[0].replace("matplotlib-base", "matplotlib"): need for need in recipe["requirements"]["run"]}
    assert conda.pop("python").split()[1] == PROJECT["requires-python"]
    assert {name: need.replace(" ", "").replace("matplotlib-base", "matplotlib") for name, need in conda.items()} == {
        name: need.replace(" ", "") for name, need in wheel.items()
    }
    commands = dict(line.split(" = ") for line in recipe["build"]["python"]["entry_points"])
    assert commands == PROJECT["scripts"]
    assert recipe["package"]["version"] == PROJECT["version"]


def test_container_has_the_packages_and_extras_of_the_project() -> None:
    text, ignored = ((ROOT / name).read_text(encoding="utf-8") for name in ("Dockerfile", ".dockerignore"))
    copied = re.findall(r"^COPY (?!--)(.*) \S+$", text, flags=re.MULTILINE)
    names = " ".join(copied).split()
    assert [name for name in names if not (ROOT / name).exists() or f"!{name}\n" not in ignored] == []
    assert {"localization", "motion_models", "skidloc"} <= set(names)
    (extras,) = re.findall(r"'\.\[(.*?)\]'", text)
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()


def test_devcontainer_makes_the_environment_of_the_makefile() -> None:
    content = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))
    target = content["postCreateCommand"].removeprefix("make ")
    assert re.search(rf"^{re.escape(target)}:", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
