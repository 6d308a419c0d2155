"""Pages in a real browser, where there is one (Debian: chromium)."""

from __future__ import annotations

import html
import importlib.util
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync")


def dom_of(page_file: Path, folder: Path, *options: str, budget_ms: int = 5000) -> str | None:
    """The page's elements after its scripts have run; None where no browser runs here."""
    if CHROMIUM is None:
        return None
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [CHROMIUM, *OPTIONS, *options, profile, f"--virtual-time-budget={budget_ms}", "--dump-dom", f"file://{page_file}"]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return shown.stdout if shown.returncode == 0 and "<body" in shown.stdout else None


def run_in_page(page: str, script: str, folder: Path, *options: str):
    """What ``script`` leaves in its object ``found`` at the end of the ``page``, with ``found.errors`` of all scripts; skips the test
    without a browser."""
    first = "<head><script>window.found = {errors: []}; onerror = text => {found.errors.push(String(text))};</script>"
    last = f'<script>{script};document.body.innerHTML = "<pre id=out>" + JSON.stringify(found) + "</pre>";</script></body>'
    made = page.replace("<head>", first).replace("</body>", last)
    made = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", made) if "script-src" not in made else made
    (folder / "page.html").write_text(made, encoding="utf-8")
    shown = dom_of(folder / "page.html", folder, *options)
    if shown is None:
        pytest.skip("no Chromium runs on this machine")
    return json.loads(html.unescape(re.search(r'<pre id="out">(.*?)</pre>', shown)[1]))


def violations_of(page: str, folder: Path, *options: str) -> list[tuple[str, str]]:
    """What axe-core (Deque Systems, MPL 2.0) finds against the ``page``, drawn in a browser: rule, and the first element and reason; skips
    the test without axe or a browser."""
    spec = importlib.util.find_spec("axe_core_python")
    if spec is None or spec.origin is None:
        pytest.skip("axe-core-python is not installed")
    axe = Path(spec.origin).with_name("axe.min.js").read_text(encoding="utf-8").replace("</script", "<\\/script")
    check = """setTimeout(() => axe.run().then(result => {
      const found = result.violations.map(v => [v.id, v.nodes[0].html.slice(0, 200) + ": " + v.nodes[0].failureSummary]);
      document.body.innerHTML = "<pre id=out></pre>";
      document.getElementById("out").textContent = JSON.stringify(found);
    }), 1000);"""
    made = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    head, _, tail = made.rpartition("</body>")
    (folder / "page.html").write_text(f"{head}<script>{axe}</script><script>{check}</script></body>{tail}", encoding="utf-8")
    shown = dom_of(folder / "page.html", folder, *options, budget_ms=20_000)
    if shown is None:
        pytest.skip("no Chromium runs on this machine")
    found = re.search(r'<pre id="out">(.*?)</pre>', shown, flags=re.DOTALL)
    assert found is not None, "axe did not end"
    return [(name, text) for name, text in json.loads(html.unescape(found[1]))]
