"""Options of `skidloc online`, and what begins before the rest of the command is imported: odometry by wheels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from localization.commands.common import print_warning
from localization.ros.early_odometry import EarlyOdometry
from localization.ros.node_config import LiveOptions, NodeConfig
from localization.ros.transports import TransportName, open_transport
from localization.ros.transports.transport import SimTimeTransport, Transport


@dataclass(frozen=True)
class CommandOptions:
    """What the command has besides settings of the node."""

    log: tyro.conf.Positional[Path | None] = None
    """A log to run from, instead of live topics."""
    rate: str = "1"
    """Speed at which the log runs: times as fast as it was recorded, or `max`."""
    view: Literal["terminal", "rerun"] = "terminal"
    """Live picture: in the terminal, or in rerun's viewer as well (extra `viz`)."""
    view_file: Path | None = None
    """New .rrd file to record rerun's picture to, instead of opening its viewer."""
    dashboard: bool = False
    """Serve a live page for browsers of this machine: map, path, covariance, scan, learned parameters, faults."""
    transport: Annotated[TransportName, tyro.conf.arg(aliases=["--door"])] = "auto"
    """Transport of live topics: ROS 2 by DDS itself (extra `ros2`), by rclpy, or by zenoh (extra `zenoh`, experimental); ROS 1 by rospy.
    `auto`: rclpy where it is sourced, else DDS, else zenoh, by what is installed."""
    domain: int | None = None
    """ROS 2 domain (transports dds and zenoh); by default that of ROS_DOMAIN_ID, or 0."""
    interface: str | None = None
    """Network interface or address (transport dds); endpoint of the router (zenoh). `localhost`: this machine only, packets of others are
    dropped; `default`: what ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE demand, else all of the subnet. Without the option, what
    these variables demand, else `localhost`."""


@dataclass(frozen=True)
class EarlyOptions(CommandOptions, LiveOptions):
    """All options of the command but the settings of the estimator."""

    @contextmanager
    def begin(self, console: Console) -> Iterator[EarlyOdometry | None]:
        """Inside, odometry by wheels runs on live topics from its first message on, or is about to begin; None for a log, where no
        predictions are wanted, and where a state on disk has the pose to begin at."""
        if self.log is not None or not self.node.predict or (self.state is not None and self.state.exists()):
            yield None
            return
        robot, node = self.robot_and_node()

        def report(text: str) -> None:
            print_warning(console, text)

        with listening(self, node, console) as transport:
            early = EarlyOdometry(transport, robot, self.topic, node, self.model, report)
            try:
                early.wait(node.wait_s)
                yield early
            finally:
                early.close()


@contextmanager
def listening(options: CommandOptions, node: NodeConfig, console: Console) -> Iterator[Transport]:
    """Inside, the transport of ``options`` is open. Raises `TransportError`."""
    transport = open_transport(options.transport, node.names, options.domain, options.interface)
    try:
        console.print(f"listening in {transport.place}, compiling meanwhile", markup=False, soft_wrap=True)
        yield SimTimeTransport(transport) if node.use_sim_time else transport
    finally:
        transport.close()
