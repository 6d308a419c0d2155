"""Documents: each command runs; each link, file and class that they name exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from localization.cli import main, parse
from tests.helpers.checkout import ROOT, enter_checkout
from tests.helpers.compare import logs

DOCUMENTS = sorted(
    path
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "localization").rglob("README.md"),
        *(ROOT / "motion_models").rglob("README.md"),
        ROOT / "tests/README.md",
    )
    if path.exists()
)


def commands_of(path: Path) -> list[str]:
    """Commands in the shell blocks of a document."""
    blocks = re.findall(r"^```sh\n(.*?)^```", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith("skidloc ")]


def examples_of(path: Path) -> list[str]:
    """Commands in blocks that are no shell blocks: they need a log of the reader's, or ROS."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    lines = [re.split(r"\s{2,}#", line)[0] for kind, block in blocks if kind not in ("sh", "python") for line in block.splitlines()]
    return [found[1] for line in lines if (found := re.search(r'(?:^|^\$ |")skidloc (\w[^"]*)', line))]


def slug(heading: str) -> str:
    """Name of a heading in a link, as of GitHub and MkDocs."""
    return re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\]\(.*?\)", "", heading).lower()).strip().replace(" ", "-")


README_COMMANDS = [command for path in DOCUMENTS if path.name == "README.md" for command in commands_of(path)]
PAGES = [path for path in DOCUMENTS if path.name != "README.md" and commands_of(path)]


def test_documents_have_commands() -> None:
    assert len(README_COMMANDS) >= 5
    assert len(PAGES) >= 7


@pytest.mark.parametrize(
    "command", [pytest.param(each, marks=[pytest.mark.extended] if each.startswith("skidloc try") else []) for each in README_COMMANDS]
)
def test_command_of_a_readme_runs(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enter_checkout(tmp_path, monkeypatch, part=10)
    assert main(shlex.split(command, comments=True)[1:]) == 0


@pytest.mark.extended
@pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page.stem in ("compare", "replay") else []) for page in PAGES]
)
def test_commands_of_a_page_run_one_after_another(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With drives in place of a reader's own."""
    enter_checkout(tmp_path, monkeypatch)
    if page.stem == "compare":
        Path("drives").mkdir()
        for name, log in zip(("monday", "tuesday"), logs(2), strict=True):
            Path(f"drives/{name}.mcap").symlink_to(log)
        Path("logs.csv").write_text("log,robot,floor,day\ndrives/monday.mcap,vaultbot,hall,\ndrives/tuesday.mcap,vaultbot,hall,\n")
    for command in commands_of(page):
        assert main(shlex.split(command, comments=True)[1:]) == 0, command


@pytest.mark.extended
def test_examples_have_options_that_exist() -> None:
    examples = [example for path in DOCUMENTS for example in examples_of(path)]
    assert len(examples) >= 8
    for example in examples:
        name, *options = shlex.split(re.sub(r"[{}]", "", example))
        assert parse(name, options) is not None, example


def test_links_to_a_heading_lead_to_one() -> None:
    missing = []
    for path in DOCUMENTS:
        for file, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", path.read_text(encoding="utf-8")):
            target = path.parent / file if file else path
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE) if target.suffix == ".md" else []
            if target.suffix == ".md" and anchor not in map(slug, headings):
                missing.append((str(path.relative_to(ROOT)), file, anchor))
    assert missing == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_of_a_document_lead_to_files(path: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    assert [link for link in links if not (path.parent / link).exists()] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_named_in_a_document_exist(path: Path) -> None:
    named = re.findall(r"`([\w/]+\.py)`", path.read_text(encoding="utf-8"))
    folders = (path.parent, ROOT, ROOT / "localization", ROOT / "localization/ros/transports", ROOT / "localization/sensor_checks")
    assert [name for name in named if not any((folder / name).exists() for folder in folders)] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_classes_named_in_a_document_exist(path: Path) -> None:
    source = "\n".join(
        file.read_text(encoding="utf-8") for folder in ("localization", "motion_models") for file in (ROOT / folder).rglob("*.py")
    )
    named = re.findall(r"`([A-Z][a-z]\w+)(?:\.(\w+))?`", path.read_text(encoding="utf-8"))
    unknown = [name for name, _ in named if not re.search(rf"^class {name}\b", source, flags=re.MULTILINE)]
    assert (
        unknown + [member for _, member in named if member and not re.search(rf"def {member}\(|^    {member}:", source, flags=re.MULTILINE)]
        == []
    )


def test_docstrings_begin_with_their_subject() -> None:
    """An editor shows them alone: one that begins with "Of" continues a sentence that stands elsewhere."""
    found = [
        f"{path.relative_to(ROOT)}: {beginning}"
        for package in ("localization", "motion_models", "skidloc")
        for path in sorted((ROOT / package).rglob("*.py"))
        for beginning in re.findall(r'^ *"""((?:Of|As|The same,?) .*)', path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert not found


def test_public_constants_have_a_docstring_each() -> None:
    """Two numbers under one text have none of their own in an editor; indices and labels are texts of one kind."""
    number = r"[-+]?(?:\d|math\.)[^\n]*"
    found = [
        f"{path.relative_to(ROOT)}: {names}"
        for package in ("localization", "motion_models", "skidloc")
        for path in sorted((ROOT / package).rglob("*.py"))
        for names in re.findall(rf'^(\w+(?:, \w+)+) = {number}\n"""', path.read_text(encoding="utf-8"), re.MULTILINE)
        if any(not name.startswith("_") for name in names.split(", "))
    ]
    assert found == ["localization/sensor_checks/scene_motion.py: HIDDEN, STILL, MOVED"]  # labels of one array
