"""ROS 2 without root: an environment of Python with rclpy from PyPI, beside the hybridmap that runs this.

    python tools/ros2.py FOLDER          # 170 MB in half a minute; prints how to run the node there

The environment has the wheels of rclpy with Fast DDS and of the messages that the node needs. Everything else, hybridmap
too, is that of the Python that runs this. There are wheels for Python 3.11 on x86-64 Linux, of ROS 2 Kilted.
"""

from __future__ import annotations

import argparse
import os
import random
import site
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

_WHEELS = (
    "ros-rclpy[fastrtps]",
    "ros-geometry-msgs",
    "ros-nav-msgs",
    "ros-sensor-msgs",
    "ros-visualization-msgs",
    "ros-diagnostic-msgs",
    "ros-std-srvs",
)
_LONGEST_S = 600.0


class Ros2Error(RuntimeError):
    """ROS 2 cannot be had or started here; the message says why."""


@dataclass(frozen=True, slots=True)
class Ros2:
    """An environment with ROS 2 in a folder."""

    folder: Path

    @property
    def python(self) -> Path:
        """Its interpreter, which has hybridmap, too."""
        return self.folder / "bin" / "python"

    def environment(self) -> dict[str, str]:
        """Environment of processes that talk to each other, and to nobody else, on this machine."""
        domain = str(random.SystemRandom().randrange(1, 100))
        return os.environ | {
            "ROS_DOMAIN_ID": domain,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "ROS_LOG_DIR": str(self.folder / "log"),
        }


def fetch(folder: Path) -> Ros2:
    """Make the environment, unless it stands in the folder.

    Raises:
        Ros2Error: the wheels cannot be had, or the folder holds something else; says why.
    """
    ros, marker = Ros2(folder.resolve()), folder / "complete"
    if marker.is_file():
        return ros
    packages = folder / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    beside = packages / "beside.pth"
    if folder.exists() and any(folder.iterdir()) and not beside.is_file():
        raise Ros2Error(f"{folder} holds something else: name a new folder")
    venv.create(folder, with_pip=False)
    paths = "".join(f"site.addsitedir({path!r}); " for path in site.getsitepackages())
    beside.write_text(f"import site; {paths}\n")  # pip takes as installed what is there
    command = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(ros.python),
        "install",
        "-q",
        "--disable-pip-version-check",
        *_WHEELS,
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Ros2Error(f"pip install: {error}") from None
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or [done.stderr.strip()[-200:]]
        raise Ros2Error(f"pip install: {said[0]}")
    tried = subprocess.run([str(ros.python), "-c", "import rclpy, hybridmap"], capture_output=True, text=True, check=False)
    if tried.returncode:
        raise Ros2Error(f"rclpy is installed and does not load: {tried.stderr.strip().splitlines()[-1]}")
    marker.write_text("\n".join(_WHEELS) + "\n")
    return ros


def main() -> None:
    """Make it, and print how it is used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    ros = fetch(parser.parse_args().folder)
    program = "from hybridmap.cli import main; main()"
    print(f"alias hybridmap-ros='{ros.python} -c \"{program}\"'")
    print("# then: hybridmap-ros ros2 --out SESSION")


if __name__ == "__main__":
    try:
        main()
    except Ros2Error as error:
        sys.exit(f"ros2: {error}")
