# SPDX-License-Identifier: Apache-2.0
"""ROS bags (rosbag2, MCAP, ROS 1), read. Importing the package registers the reader; rosbags is imported when one is opened."""

from manyeyes.datasets.ros.reader import RosbagRecording

__all__ = ["RosbagRecording"]
