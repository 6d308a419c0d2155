"""A load beside the middle is a load, and no unit of the wheels that changes within the log."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from localization.evidence import infer_set_up
from localization.logs import open_log
from localization.simulation.simulator import write_simulation
from motion_models.robot_file import load_robot
from tests.studies.loaded_robots import MINUTE
from tests.studies.weigh import simulation_of


@pytest.mark.slow
def test_load_beside_the_middle_changes_no_unit_of_the_wheels(tmp_path: Path) -> None:
    """Its centre of rotation is 0.2 m to the side: in arcs to the left the robot goes farther than its wheels roll, and "the wheels' rates
    are 1.25 times too small since t = 14 s" had 0.995."""
    robot = dataclasses.replace(load_robot("warthog"), models={}, options={})
    load = {"cg_offset_x": -0.100, "cg_offset_y": -0.150}
    write_simulation(tmp_path / "minute.mcap", simulation_of("mujoco", MINUTE, robot, 21, load))
    found = infer_set_up(open_log(tmp_path / "minute.mcap", robot))
    assert (found.verdict, found.sentences) == ("consistent", ())
