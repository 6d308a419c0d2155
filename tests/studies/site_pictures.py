"""Pictures of the site: what commands print as SVG, and their pages in Chromium. `python -m tests.studies.site_pictures FOLDER`.

Commands run on logs of the repository and on simulated drives, with their results in FOLDER; docs/images gets the pictures. Names as
further arguments choose some of them.
"""

from __future__ import annotations

import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.text import Text

from localization.cli import COMMANDS, main
from localization.commands.arguments import bash_completion
from tests.helpers.compare import logs as short_drives

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
HUSKY = "tests/data/husky-outdoor-gps/test1.bag"
_WIDTH = 1100
PAGES = {
    "check": ("check {husky} --robot husky_a200 --out {out}", "check.html", 800),
    "diagnose": ("diagnose tests/data/vaultbot/rotation_grid.csv --robot vaultbot --out {out}", "diagnosis.html", 1000),
    "calibrate": ("calibrate {laps} --robot vaultbot --model friction --page {out}", "", 900),
    "weigh": ("weigh {load} --robot vaultbot --page {out}", "", 800),
    "compare": ("compare {drives} --robot vaultbot --model diff_drive,skid_steer --estimator odometry --out {out}", "report.html", 1000),
    "try": ("try {laps} --robot vaultbot --out {out}", "index.html", 1000),
}
TERMINALS = {"info": ("info {husky} --robot husky_a200", 34)}
_SIMULATED = {
    "laps": "simulate laps --config.experiment.laps 2 --out {path}",
    "load": "simulate laps --config.experiment.laps 2 --seed 1 --effect payload=8 --out {path}",
}


def log_of(name: str, folder: Path) -> str:
    """Path of a simulated drive, which is made once; "drives" is six short ones without a LiDAR."""
    if name == "drives":
        return " ".join(map(str, short_drives(6)))
    path = folder / f"{name}.mcap"
    if not path.exists():
        main(shlex.split(_SIMULATED[name].format(path=path)))
    return str(path)


def filled(command: str, folder: Path, out: Path) -> str:
    """``command`` with its logs and its output."""
    logs = {name: log_of(name, folder) for name in ("laps", "load", "drives") if f"{{{name}}}" in command}
    return command.format(husky=HUSKY, out=out, **logs)


def page(name: str, folder: Path) -> None:
    """Run the command and photograph its page."""
    command, file, height = PAGES[name]
    out = folder / (name if file else f"{name}.html")
    if not out.exists():
        main(shlex.split(filled(command, folder, out)))
    shown = out / file if file else out
    target = IMAGES / f"{name}.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=9000"]
    subprocess.run(
        ["chromium", *options, f"--window-size={_WIDTH},{height}", f"--screenshot={target}", f"file://{shown.absolute()}"], check=True
    )
    shrink(target)


def shrink(path: Path) -> None:
    """Write a PNG anew with 64 colours, which text and lines do with."""
    from PIL import Image  # comes with matplotlib

    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


def terminal(name: str, command: str, text: str) -> None:
    """What a command prints as SVG."""
    console = Console(width=120, record=True, file=io.StringIO(), highlight=False)
    console.print(Text(f"$ {command}", style="bold"))
    console.print(Text(text.rstrip()))
    drawn = re.sub(r"@font-face \{.*?\}\s*", "", console.export_svg(title=""), flags=re.DOTALL)  # nothing is loaded from elsewhere
    (IMAGES / f"{name}.svg").write_text(drawn.replace("Fira Code", "monospace"), encoding="utf-8")


def printed(command: str) -> str:
    """Output of a command in a process of its own."""
    code = "import sys; from localization.cli import main; sys.exit(main(sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", code, *shlex.split(command)], capture_output=True, text=True, cwd=ROOT, check=False).stdout


def completion() -> None:
    """What the shell completes."""
    (IMAGES / "completion.sh").write_text(bash_completion(COMMANDS), encoding="utf-8")
    lines = []
    for words in ("skidloc ca", "skidloc init drive.bag --", "skidloc replay drive.bag --robot ro"):
        script = "source completion.sh; COMP_WORDS=({}); COMP_CWORD={}; _skidloc; echo ${{COMPREPLY[@]}}"
        script = script.format(words, len(words.split()) - 1)
        found = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=IMAGES, check=True).stdout
        lines += [f"$ {words}<Tab>", found.strip()]
    (IMAGES / "completion.sh").unlink()
    terminal("completion", "source <(skidloc --completion)", "\n".join(lines))


if __name__ == "__main__":
    work = Path(sys.argv[1])
    work.mkdir(parents=True, exist_ok=True)
    IMAGES.mkdir(exist_ok=True)
    chosen = sys.argv[2:] or [*TERMINALS, "completion", *PAGES]
    for each in chosen:
        if each in TERMINALS:
            line, most = TERMINALS[each]
            terminal(each, f"skidloc {line.format(husky=HUSKY)}", "\n".join(printed(line.format(husky=HUSKY)).splitlines()[:most]))
        elif each == "completion":
            completion()
        else:
            page(each, work)
