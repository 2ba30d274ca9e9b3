"""The ROS 2 message types that a flight is made of, and their schema texts, from the rosbags typestore."""

from __future__ import annotations

from functools import lru_cache

from rosbags.typesys import Stores, get_typestore

POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

# Humble is the oldest distribution in use; these types have not changed since.
STORE = get_typestore(Stores.ROS2_HUMBLE)


@lru_cache(maxsize=32)
def definition(msgtype: str) -> str:
    """The `ros2msg` schema text of a type with all its dependencies."""
    return STORE.generate_msgdef(msgtype, ros_version=2)[0]


def stamp_parts(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a ROS time.

    Raises:
        ValueError: outside the int32 seconds that ROS can hold.
    """
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    if not -(2**31) <= sec < 2**31:
        raise ValueError(f"stamp {stamp_ns} ns does not fit a ROS time")
    return sec, nanosec
