"""Page of `skidloc check`: each quantity with its second source and a verdict, what to correct, and what to drive."""

from __future__ import annotations

from pathlib import Path

from localization.calibration.robot_check import NEXT_DRIVE, CheckRow, RobotCheck
from localization.report import page as html

_MARKS = {"ok": "green", "contradiction": "red", "cannot be seen": "grey", "note": "grey"}
_FILES = {
    "robot.toml": "the robot, with what is certain corrected; every command takes it as --robot.",
    "diff_drive_controller.yaml": "radius, separation, multipliers and covariance for ros2_controllers.",
    "robot_localization.yaml": "what the filter may fuse of these wheels.",
    "slam_toolbox.yaml": "frames, topic and when to take a scan.",
}
_TERMS = {
    "Value": "What the robot file, the URDF or the log has, and with which skidloc runs where nothing contradicts it.",
    "Second source": "Another measurement of the same quantity, and what it measured.",
    "Contradiction": "The two differ by more than noise and slip explain; what to correct stands beside it.",
    "Cannot be seen": "The log does not show it: what to record or to drive stands beside it.",
    "Note": "Of the log's file: what was lost, or moved because the recorder's clock was set back.",
}


def write_check_page(path: str | Path, found: RobotCheck, files: dict[str, str]) -> None:
    """Write the page; ``files``: text of the files that stand beside it, by name. Raises `OutputError`."""
    html.write_new(path, check_page(found, files).encode())


def check_page(found: RobotCheck, files: dict[str, str]) -> str:
    """HTML of the whole page."""
    wrong = [row for row in found.rows if row.verdict == "contradiction"]
    unseen = [row for row in found.rows if row.verdict == "cannot be seen"]
    notes = [row.advice for row in found.rows if row.verdict == "note"]
    sections = [
        html.Section("Log file", html.bullets(notes)),
        html.Section("Contradictions", html.bullets([f"{row.quantity}: {row.advice}" for row in wrong])),
        html.Section("All quantities", _table(found.rows)),
        html.Section("To record or to drive", _to_drive(unseen)),
        html.Section("Files beside this page", html.bullets([f"{name}: {_FILES.get(name, '')}" for name in files])),
        html.glossary(_TERMS),
    ]
    facts = f"{found.robot.name} · {found.duration_s:.0f} s · {len(found.rows) - len(notes)} quantities"
    return html.render(html.Page(f"Check of {found.log}", facts, [found.sentence], sections))


def _table(rows: tuple[CheckRow, ...]) -> list[html.Block]:
    header = [html.Cell(title) for title in ("Quantity", "Verdict", "Value", "Second source")]
    cells = []
    for row in rows:
        cells.append(
            [html.Cell(row.quantity), html.Cell(row.verdict, mark=_MARKS[row.verdict]), html.Cell(row.value), html.Cell(row.second_source)]
        )
    return [html.Table(header, cells, is_text=True, is_sortable=True)]


def _to_drive(unseen: list[CheckRow]) -> list[html.Block]:
    if not unseen:
        return []
    return [*html.bullets([f"{row.quantity}: {row.advice}" for row in unseen]), html.Paragraph(NEXT_DRIVE)]
