"""Write any stream with odometry as a ROS 1 bag, a ROS 2 bag or a TUM RGB-D folder that reads back to the same bits."""

from hybridmap.simulation.writers.bags import write_rosbag1, write_rosbag2
from hybridmap.simulation.writers.tum_folder import write_tum

__all__ = ["write_rosbag1", "write_rosbag2", "write_tum"]
