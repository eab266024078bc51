"""ROS 1 without root and without installing anything: Debian's packages, unpacked into a folder.

    python tools/ros1.py FOLDER          # some 60 small packages, 6 MB; prints what to export

`hybridmap ros1`, `rosmaster` and `rosbag play` then run from there. Debian bookworm and Ubuntu 24.04 have these packages.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_PYTHON = (
    *(
        "rospy",
        "rosmaster",
        "rosgraph",
        "rosgraph-msgs",
        "roslib",
        "genpy",
        "genmsg",
        "roscpp-msg",
        "rosbag",
        "roslz4",
        "rospkg",
    ),
    *("catkin", "catkin-pkg", "distro", "std-msgs", "std-srvs", "geometry-msgs", "nav-msgs", "sensor-msgs", "tf2-msgs"),
    *("visualization-msgs", "diagnostic-msgs", "actionlib-msgs", "defusedxml", "netifaces", "gnupg", "pycryptodome"),
)
"""Python packages. PyYAML is that of hybridmap, which a second one must not hide."""
_PLAYER = re.compile(
    r"lib(ros|boost-(chrono|filesystem|program-options|regex|thread)|console-bridge|cpp-common|xmlrpcpp|log4cxx|apr|topic-tools"
    r"|class-loader|tinyxml2|gpgme|assuan|ament-index|rcpputils|rcutils|b64)"
)
"""Libraries of `rosbag play`, by the beginnings of their names: the rest carries versions, which differ."""
_START_S = 20.0


class Ros1Error(RuntimeError):
    """ROS 1 cannot be had or started here; the message says why."""


@dataclass(frozen=True, slots=True)
class Ros1:
    """ROS 1 unpacked in a folder."""

    folder: Path

    @property
    def python_path(self) -> Path:
        """What to append to `sys.path` for rospy."""
        return self.folder / "root" / "usr" / "lib" / "python3" / "dist-packages"

    @property
    def player(self) -> Path:
        """The program behind `rosbag play`."""
        return self.folder / "root" / "usr" / "lib" / "rosbag" / "play"

    def environment(self, port: int = 11311) -> dict[str, str]:
        """Environment of a process that talks to a master on this port of the loopback device."""
        libraries = [str(path) for path in (self.folder / "root" / "usr" / "lib").glob("*-linux-gnu")]
        before = [os.environ[name] for name in ("PYTHONPATH",) if os.environ.get(name)]
        return os.environ | {
            "PYTHONPATH": os.pathsep.join([*before, str(self.python_path)]),
            "LD_LIBRARY_PATH": os.pathsep.join([*libraries, *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]),
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_IP": "127.0.0.1",
            "ROS_LOG_DIR": str(self.folder / "log"),
            "ROS_PACKAGE_PATH": str(self.folder / "root" / "usr" / "share"),
            "CMAKE_PREFIX_PATH": str(self.folder / "root" / "usr"),  # where rosbag looks for its plugins
        }


def fetch(folder: Path) -> Ros1:
    """Download and unpack the packages, unless the folder has them.

    Raises:
        Ros1Error: they cannot be had; says why.
    """
    ros, marker = Ros1(folder), folder / "complete"
    if marker.is_file():
        return ros
    for program in ("apt-get", "apt-cache", "dpkg"):
        if shutil.which(program) is None:
            raise Ros1Error(f"{program} is not here: Debian's packages of ROS 1 need it")
    debs = folder / "debs"
    debs.mkdir(parents=True, exist_ok=True)
    names = [f"python3-{name}" for name in _PYTHON]
    needs = _run("apt-cache", "depends", "--recurse", "--important", "python3-rosbag").stdout.splitlines()
    names += sorted({name for name in needs if _PLAYER.match(name) and not name.endswith("-dev")})
    done = _run("apt-get", "download", "-q", *names, cwd=debs)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("E:")] or [done.stderr.strip()[-200:]]
        raise Ros1Error(f"apt-get download: {said[0]}; is `apt-get update` needed, or has this release no ROS 1?")
    for deb in sorted(debs.glob("*.deb")):
        unpacked = _run("dpkg", "-x", str(deb), str(folder / "root"))
        if unpacked.returncode:
            raise Ros1Error(f"dpkg -x {deb.name}: {unpacked.stderr.strip()}")
    for plugin in (folder / "root" / "usr" / "lib").glob("*/ros/*.so"):
        (folder / "root" / "usr" / "lib" / plugin.name).symlink_to(plugin)
    marker.write_text("\n".join(names) + "\n")
    return ros


def _run(*command: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def free_port() -> int:
    """A port of the loopback device that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def master(ros: Ros1, settings: Sequence[str] = ()) -> Iterator[dict[str, str]]:
    """Run a real `rosmaster` on a free port of the loopback device; yields the environment of its nodes.

    Raises:
        Ros1Error: it does not start.
    """
    port = free_port()
    environment = ros.environment(port)
    code = "import sys; from rosmaster.main import rosmaster_main; rosmaster_main(sys.argv[1:])"
    log = ros.folder / f"rosmaster-{port}.log"
    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", code, "--core", "-p", str(port), *settings], env=environment, stdout=out, stderr=out
        )
    try:
        wait_for_port(port, process, log)
        yield environment
    finally:
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()


def wait_for_port(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until a process listens.

    Raises:
        Ros1Error: it ended, or does not listen in time.
    """
    until_s = time.monotonic() + _START_S
    while time.monotonic() < until_s:
        if process.poll() is not None:
            break
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    last = (log.read_text().strip().splitlines() or ["it said nothing"])[-1]
    raise Ros1Error(f"rosmaster does not listen on port {port}: {last}")


def main() -> None:
    """Fetch, and print what a shell needs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    ros = fetch(parser.parse_args().folder.resolve())
    here = ros.environment()
    for name in (
        "PYTHONPATH",
        "LD_LIBRARY_PATH",
        "ROS_MASTER_URI",
        "ROS_HOSTNAME",
        "ROS_LOG_DIR",
        "ROS_PACKAGE_PATH",
        "CMAKE_PREFIX_PATH",
    ):
        print(f"export {name}={here[name]!r}")
    run = "from rosmaster.main import rosmaster_main; rosmaster_main()"
    print(f"# a master:        {sys.executable} -c {run!r} --core")
    print(f"# rosbag play:     {ros.player} --rate=1 drive.bag")


if __name__ == "__main__":
    try:
        main()
    except Ros1Error as error:
        sys.exit(f"ros1: {error}")
