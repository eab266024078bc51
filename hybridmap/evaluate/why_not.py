"""Why no node was made, and why no loop was found, where the settings alone tell it: texts of `explain`."""

from __future__ import annotations

NO_NODE = {
    "novelty": "neither a new view template nor a place code {} from every node's (nodes.place_threshold)",
    "passage": "neither a new view template nor a place code {} from the newest node's (nodes.place_threshold)",
    "views": "neither a new view template nor another experience",
}
"""By the rule by which nodes are made (`nodes.rule`); `{}` stands for `nodes.place_threshold`."""
NO_LOOPS = {
    "scanline": "no older node lay inside the gate, or the robot turned here, or the drive told no threshold yet",
    "ratslam": "no earlier experience has both its view cell and its place on the pose cells",
    "nothing": "loops are not looked for (vision.closing.by)",
}
"""By what closes loops (`vision.closing.by`)."""
