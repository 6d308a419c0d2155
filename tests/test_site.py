"""The site of docs/: equations have their line of code, all warnings have cause and cure, and what it shows in Python runs."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tests.helpers.checkout import enter_checkout
from tests.helpers.extended import cases

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
SNIPPETS = {
    f"{page.stem} {i}": block
    for page in PAGES
    for i, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL))
    if "import rclpy" not in block  # run by tests/test_online_messages.py
}


def hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


HOOKS = hooks()


@pytest.mark.parametrize("page", sorted((DOCS / "theory").glob("*.md")), ids=lambda page: page.stem)
def test_displayed_equation_is_followed_by_its_line_of_code(page: Path):
    text = page.read_text(encoding="utf-8")
    parts = re.split(r"^\$\$.*\$\$$", text, flags=re.MULTILINE)[1:]
    lines = [HOOKS.CODE.search(part) for part in parts]
    assert parts
    assert all(lines), "an equation without a line of code"
    for found in HOOKS.CODE.finditer(text):
        HOOKS.find_line(found["path"], found["text"])  # raises where the line is not there any more


def test_equation_stands_once_in_all_pages():
    equations = [e for page in PAGES for e in re.findall(r"^\$\$(.*)\$\$$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)]
    assert len(equations) >= 15
    assert len(equations) == len(set(equations))


def test_line_that_is_gone_is_an_error():
    with pytest.raises(ValueError, match=r"0 lines"):
        HOOKS.find_line("localization/errors.py", "this is not there")


def test_equation_becomes_mathml():
    pytest.importorskip("latex2mathml")
    made = HOOKS.on_page_content('<div class="arithmatex">\\[\na \\le b^2\n\\]</div>')
    assert made.startswith("<math")
    assert 'display="block"' in made
    assert "<msup>" in made


@pytest.mark.parametrize("name", cases(SNIPPETS, usual=["api 1"]))
def test_python_of_a_page_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if "to_pandas" in SNIPPETS[name]:
        pytest.importorskip("pandas")
    enter_checkout(tmp_path, monkeypatch)
    exec(compile(SNIPPETS[name], name, "exec"), {})
