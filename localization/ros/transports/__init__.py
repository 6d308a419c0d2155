"""Transports: bytes of topics in and out of a robot's network, one module each, imported only where it is wanted."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import Literal

from localization.ros.node_config import Names
from localization.ros.transports.transport import Transport, default_domain

TransportName = Literal["auto", "dds", "rclpy", "zenoh", "rospy"]


_MODULES: Mapping[TransportName, str] = {"rclpy": "rclpy", "dds": "cyclonedds", "zenoh": "zenoh"}
"""What each transport of ROS 2 needs, the preferred one first. cyclonedds has no wheel for aarch64: there, the extra `ros2` is zenoh."""


def choose_transport() -> TransportName:
    """rclpy where a ROS 2 is sourced, else DDS or zenoh, by which package is installed; DDS, whose error names the extra, if none is."""
    return next((kind for kind, module in _MODULES.items() if importlib.util.find_spec(module) is not None), "dds")


def open_transport(kind: TransportName, names: Names, domain: int | None, interface: str | None) -> Transport:
    """The transport ``kind``; `auto` is what `choose_transport` has found.

    ``domain`` (dds, zenoh): by default that of ROS_DOMAIN_ID, or 0. ``interface``: see `dds.choose_interface`; of zenoh the
    endpoint of its router. Raises `TransportError`.
    """
    if kind == "auto":
        kind = choose_transport()
    if kind == "rospy":
        from localization.ros.transports.rospy import RospyTransport

        return RospyTransport()
    if kind == "rclpy":
        from localization.ros.transports.rclpy import RclpyTransport

        return RclpyTransport(names.name, names.namespace)
    domain = default_domain() if domain is None else domain
    if kind == "zenoh":
        from localization.ros.transports.zenoh import ZenohTransport

        return ZenohTransport(domain, interface, names.name, names.namespace)
    from localization.ros.transports.dds import DdsTransport, choose_interface

    return DdsTransport(domain, choose_interface(interface), names.name, names.namespace)
