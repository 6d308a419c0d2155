"""No kernel is compiled, or loaded, after the warm-up: checked in a process of its own, in which none is yet."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import sys
from numba.core.registry import CPUDispatcher
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.settings import LiveRun
from localization.ros.session import Files
from localization.pipeline import Trial
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, LogTransport, drive_log

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith(("localization", "motion_models"))]
    kernels = {id(v): v for m in modules for v in vars(m).values() if isinstance(v, CPUDispatcher)}
    return {f"{k.py_func.__module__}.{k.py_func.__name__}": len(k.overloads) for k in kernels.values()}

for estimator, model in (("ekf", "skid_steer"), ("graph", "friction")):
    transport = LogTransport(drive_log())
    trial = Trial(make_model(model, ROBOT), estimator)
    run = LiveRun(ROBOT, lambda has_lidar: trial, node=NodeConfig(wait_s=0.0))
    WarmUp(run).wait()
    before = compiled()
    node = Node.start(transport, run, print)
    node.spin(transport.is_empty)
    node.finish()
    after = compiled()
    assert before["localization.lidar.registration._align"] == 1, before
    planar = [name for name in before if name.startswith("localization.lidar") and "cloud_map" not in name and "_in_space" not in name]
    print("not compiled:", [name for name in planar if before[name] == 0])
    print("compiled late:", {name: n for name, n in after.items() if n > before.get(name, 0)})
"""


@pytest.mark.extended
def test_node_compiles_nothing_after_the_warm_up():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if "compiled late" in line] == 2 * ["compiled late: {}"]
    assert [line for line in done.stdout.splitlines() if "not compiled" in line] == 2 * ["not compiled: []"]
