"""Pages in a real browser, where there is one (Debian: chromium)."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync")


def dom_of(page_file: Path, folder: Path, *options: str) -> str | None:
    """The page's elements after its scripts have run; None where no browser runs here."""
    if CHROMIUM is None:
        return None
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [CHROMIUM, *OPTIONS, *options, profile, "--virtual-time-budget=5000", "--dump-dom", f"file://{page_file}"]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return shown.stdout if shown.returncode == 0 and "<body" in shown.stdout else None


def run_in_page(page: str, script: str, folder: Path, *options: str):
    """What ``script`` leaves in its object ``found`` at the end of the ``page``, with ``found.errors`` of all scripts; skips the test
    without a browser."""
    plain = folder / "plain.html"
    plain.write_text("<html><body>a page</body></html>")
    if "a page" not in (dom_of(plain, folder) or ""):
        pytest.skip("no Chromium runs on this machine")
    first = "<head><script>window.found = {errors: []}; onerror = text => {found.errors.push(String(text))};</script>"
    last = f'<script>{script};document.body.innerHTML = "<pre id=out>" + JSON.stringify(found) + "</pre>";</script></body>'
    made = page.replace("<head>", first).replace("</body>", last)
    made = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", made) if "script-src" not in made else made
    (folder / "page.html").write_text(made, encoding="utf-8")
    return json.loads(re.search(r'<pre id="out">(.*?)</pre>', dom_of(folder / "page.html", folder, *options))[1])
