"""The proof of `live_proof.py` under ROS 2: the node, and a player that listens to it, in processes of its environment."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from typing import Any

from ros2 import Ros2Error, fetch

_PLAYER = Path(__file__).with_name("ros2_play.py")
_PROGRAM = "from hybridmap.cli import main; main()"
_END_S = 600.0


def play(
    bag: Path, ros_folder: Path, rate: float, odometry: str, settings: list[str], folder: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Map what is played.

    Returns:
        The head of the session, and what the player heard.

    Raises:
        Ros2Error: the node or the player fails.
    """
    ros, out = fetch(ros_folder), folder / "live"
    environment = ros.environment()
    more = [word for setting in settings for word in ("--set", setting)]
    log = folder / "node.log"
    with log.open("w") as said:
        command = [str(ros.python), "-c", _PROGRAM, "ros2", "--out", str(out), *more]
        node = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        try:
            playing = [str(ros.python), str(_PLAYER), str(bag), f"--rate={rate}", f"--odometry={odometry}"]
            played = subprocess.run(playing, env=environment, capture_output=True, text=True, check=False)
            node.send_signal(signal.SIGINT)
            node.wait(_END_S)
        finally:
            node.kill()
    if node.returncode:
        raise Ros2Error(f"hybridmap ros2 ended with exit code {node.returncode}: {log.read_text()[-500:]}")
    if played.returncode:
        raise Ros2Error(f"the player ended with exit code {played.returncode}: {played.stderr.strip()[-500:]}")
    return json.loads((out / "metrics.json").read_text()), json.loads(played.stdout.splitlines()[-1])
