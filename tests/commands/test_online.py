"""The picture in the terminal, on a run of the node."""

from __future__ import annotations

import functools
import io

import pytest
from rich.cells import cell_len
from rich.console import Console

from localization.commands.online import terminal_view
from localization.ros.diagnostics import ERROR, WARN, Status
from tests.helpers.extended import cases
from tests.helpers.online import LogTransport, drive_log, run_node

pytestmark = pytest.mark.xdist_group("online")
STATUSES = [
    Status("lidar"),
    Status("wheels", WARN, "they turn otherwise than the robot moves: slip"),
    Status("messages", ERROR, "no messages come on /imu/data, /center_of_gravity_by_the_arms"),
]


@functools.cache
def driven():
    return run_node(LogTransport(drive_log()))[0]


def drawn(width):
    node = driven()
    console = Console(file=io.StringIO(), width=width)
    console.print(terminal_view(node.session, node.seconds, STATUSES, node.rates(), "1.0x"))
    return console.file.getvalue().splitlines()


@pytest.mark.extended
@pytest.mark.parametrize("width", cases([16, 30, 45, 80, 132, 300], ("45",)))
def test_terminal_view_fits_any_width_and_loses_nothing(width):
    lines = drawn(width)
    assert max(cell_len(line) for line in lines) <= width
    label_cells = max(len(label) for label in ("messages", "learned"))
    text = "".join(line[label_cells:].strip().replace(" ", "") for line in lines)
    for wanted in ("skid_steer_ekf", "NIS", "/scan12.", "slip", "/center_of_gravity_by_the_arms"):
        assert wanted in text


def test_terminal_view_has_a_row_for_each_subject_and_warning():
    rows = {line.split()[0]: line for line in drawn(300)}
    assert list(rows) == ["state", "pose", "sigma", "motion", "rates", "learned", "wheels", "messages"]
    assert rows["rates"].count("Hz") == 3
    assert "+-" in rows["learned"]


def test_terminal_view_before_the_first_estimate_names_what_it_needs():
    node = run_node(LogTransport(drive_log(), lambda messages: messages[:3]))[0]
    console = Console(file=io.StringIO(), width=80)
    console.print(terminal_view(node.session, node.seconds, []))
    assert "no estimate yet" in console.file.getvalue()
