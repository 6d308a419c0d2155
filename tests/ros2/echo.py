"""The floor of every latency: a node on rclpy that answers each scan by an Odometry with its stamp, and does nothing else."""

import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan


def main():
    rclpy.init(args=[])
    node = rclpy.create_node("echo")
    publisher = node.create_publisher(Odometry, "/echo/odometry", 10)

    def answer(scan):
        odometry = Odometry()
        odometry.header = scan.header
        publisher.publish(odometry)

    node.create_subscription(LaserScan, "/scan", answer, qos_profile_sensor_data)
    print("up", flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
