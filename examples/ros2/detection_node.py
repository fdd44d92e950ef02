# SPDX-License-Identifier: Apache-2.0
"""A node for ROS 2: cloud and pose in, packets to and from other agents, detections out. Not run by this project: see README.md."""

import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from sensor_msgs_py import point_cloud2
from std_msgs.msg import UInt8MultiArray
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

from manyeyes import Agent, AgentFrame, Boxes, PointCloud, Transform, load_detector
from manyeyes.models.score_calibration import default_drawing_score

MAX_POSE_AGE_NS = 50_000_000
MAX_PACKETS = 1024


def stamp_ns(header) -> int:
    """Return the time of a header in nanoseconds."""
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def read_pose(pose: PoseStamped) -> np.ndarray:
    """Return a pose as a 4x4 matrix: world_from_lidar."""
    q, p = pose.pose.orientation, pose.pose.position
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), p.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), p.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), p.z],
            [0, 0, 0, 1],
        ]
    )


def make_detections(boxes: Boxes, header, sensor_height_m: float, min_score: float) -> Detection3DArray:
    """Return boxes of the agent's frame as detections in the frame of the LiDAR."""
    out = Detection3DArray(header=header)
    for center, size, yaw, score in zip(
        boxes.center.tolist(), boxes.size.tolist(), boxes.yaw.tolist(), boxes.score.tolist()
    ):
        if score < min_score:
            continue
        detection = Detection3D(header=header)
        position, orientation = detection.bbox.center.position, detection.bbox.center.orientation
        position.x, position.y, position.z = center[0], center[1], center[2] - sensor_height_m
        orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        detection.bbox.size.x, detection.bbox.size.y, detection.bbox.size.z = size
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id, result.hypothesis.score = "vehicle", score
        detection.results.append(result)
        out.detections.append(detection)
    return out


class DetectionNode(Node):
    """One agent: shares each sweep, and perceives with the packets since the last one."""

    def __init__(self) -> None:
        super().__init__("manyeyes")
        self.agent_id = self.declare_parameter("agent_id", 1).value
        self.sensor_height_m = self.declare_parameter("sensor_height_m", 1.9).value
        self.max_intensity = self.declare_parameter("max_intensity", 255.0).value
        budget_bytes = self.declare_parameter("budget_bytes", 4096).value
        detector = load_detector(self.declare_parameter("weights", "costr-small").value)
        self.agent = Agent(detector, budget_bytes=budget_bytes)
        self.min_score = default_drawing_score(detector, "fused")
        self.pose: PoseStamped | None = None
        self.packets: list[bytes] = []
        self.own: set[bytes] = set()
        self.to_others = self.create_publisher(UInt8MultiArray, "packets", 100)
        self.detections = self.create_publisher(Detection3DArray, "detections", 1)
        self.create_subscription(UInt8MultiArray, "packets", self.receive, 100)
        self.create_subscription(PoseStamped, "pose", self.set_pose, qos_profile_sensor_data)
        self.create_subscription(PointCloud2, "points", self.step, qos_profile_sensor_data)

    def set_pose(self, pose: PoseStamped) -> None:
        """Keep the latest pose."""
        self.pose = pose

    def receive(self, message: UInt8MultiArray) -> None:
        """Keep a packet of another agent, the latest ones only."""
        packet = bytes(message.data)
        if packet not in self.own:
            self.packets = [*self.packets[1 - MAX_PACKETS :], packet]

    def step(self, cloud: PointCloud2) -> None:
        """Share this sweep, perceive with what arrived, publish detections."""
        if self.pose is None or abs(stamp_ns(self.pose.header) - stamp_ns(cloud.header)) > MAX_POSE_AGE_NS:
            self.get_logger().warning("no pose near this sweep", throttle_duration_sec=1.0)
            return
        points = point_cloud2.read_points(cloud, ("x", "y", "z", "intensity"), skip_nans=True)
        xyz = np.stack([points[name].astype(np.float32) for name in ("x", "y", "z")], 1)
        xyz[:, 2] += self.sensor_height_m  # z = 0 is the road
        intensity = np.clip(points["intensity"].astype(np.float32) / self.max_intensity, 0, 1)
        world_from_lidar = Transform.from_matrix(read_pose(self.pose))
        frame = AgentFrame.of(
            PointCloud.of(xyz, intensity),
            world_from_lidar @ Transform.from_xyz_yaw(0, 0, -self.sensor_height_m),
            self.agent_id,
            stamp_ns(cloud.header),
            sensor_height_m=self.sensor_height_m,
        )
        sent = self.agent.share(frame)
        self.own = set(sent)
        for packet in sent:
            self.to_others.publish(UInt8MultiArray(data=list(packet)))
        received, self.packets = self.packets, []
        boxes = self.agent.perceive(frame, received).boxes
        self.detections.publish(make_detections(boxes, cloud.header, self.sensor_height_m, self.min_score))


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = DetectionNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
