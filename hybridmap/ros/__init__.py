"""A robot under ROS: its topics in, the map and `map -> odom` out, and the services that operators know.

`RobotNode` is the node without a middleware; `ros1` connects it to ROS 1. ROS is no dependency: it is found at run time.
"""
