"""What a node on DDS costs without an estimator: receives the topics of `dds_peer`'s robot through our transport, and answers each wheel
message by transforms and a predicted odometry, each scan by an odometry as well, of fixed content but for the stamp.

python -m tests.helpers.dds_relay DOMAIN
"""

import sys

import numpy as np

from localization.logs.fused_messages import FusedEstimate
from localization.logs.serialization import FusedWriter
from localization.ros.discovery import TF, TF_TYPE
from localization.ros.transports.dds import DdsTransport

ODOMETRY, PREDICTED = "/skidloc/odometry", "/skidloc/odometry_predicted"
TOPICS = {"/joint_states": "JointState", "/imu/data": "Imu", "/scan": "LaserScan"}
_STAMP = slice(4, 12)
"""Bytes of the stamp in every message that begins with a header, behind CDR's encapsulation."""


def main(domain: int) -> None:
    transport = DdsTransport(domain)
    for topic, kind in TOPICS.items():
        transport.subscribe(topic, f"sensor_msgs/msg/{kind}", is_latched=False)
    for topic, kind in ((ODOMETRY, "nav_msgs/msg/Odometry"), (PREDICTED, "nav_msgs/msg/Odometry"), (TF, TF_TYPE)):
        transport.advertise(topic, kind)
    transport.restrict([*TOPICS], ["/joint_states", "/scan"])
    writer, estimate = FusedWriter(is_ros1=False, parent="odom", body="base_link"), FusedEstimate(0, np.zeros(3), np.zeros(3))
    odometry, transform = bytearray(writer.odometry(estimate)), writer.transform(estimate)
    print("listening", flush=True)
    while True:
        for received in transport.take(0.05, 0.02):
            odometry[_STAMP] = received.data[_STAMP]
            if received.topic == "/scan":
                transport.publish(ODOMETRY, bytes(odometry))
            if received.topic != "/imu/data":
                transport.publish(PREDICTED, bytes(odometry))
                transport.publish(TF, transform)


if __name__ == "__main__":
    main(int(sys.argv[1]))
