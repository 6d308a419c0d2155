"""Settings of Cyclone DDS that ROS 2's own middlewares interoperate with, and which network interface they are for.

Every setting was found necessary with Fast DDS 2.14 (Jazzy) or 3.2 (Kilted) as the other side.
"""

from __future__ import annotations

import difflib
import os
import socket
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import quoteattr

from localization.errors import TransportError

LOOPBACK, DEFAULT = "lo", "default"
LAST_DOMAIN = 230
_LOOPBACK_NAMES = ("lo", "localhost", "127.0.0.1")
_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")

# Fast DDS 3.2 sends type objects that Cyclone 11 cannot parse (`ddsi_xt_type_add_typeobj with invalid type object`): nothing is delivered.
# Topics are matched by type name here, so that they are not needed. 1.15: messages of Fast DDS (vendor 1.15) only.
_COMPATIBILITY = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
# A cloud of 4 MB is one burst of datagrams. The kernel grants at most net.core.rmem_max; less is no error.
_BUFFER = '<Internal><SocketReceiveBufferSize min="default" max="4MB"/></Internal>'
# Without multicast a participant is found only by asking its port. By default Cyclone stops asking after 30 s: robots that start later, or
# again, were never found (9 of 9 restarts); like this they are within 0.5 s.
_ASKING = (
    "<SPDPInterval>1s</SPDPInterval><InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
)


def default_domain(environment: Mapping[str, str] = os.environ) -> int:
    """ROS 2's domain by ROS_DOMAIN_ID, 0 without it. Raises `TransportError`."""
    value = environment.get("ROS_DOMAIN_ID") or "0"
    if not (value.isdecimal() and int(value) <= LAST_DOMAIN):
        raise TransportError(
            f"ROS_DOMAIN_ID is '{value}'; ROS 2's domains are the numbers 0 to {LAST_DOMAIN}. Correct it, or pass --domain."
        )
    return int(value)


def choose_interface(interface: str | None, environment: Mapping[str, str] = os.environ) -> str:
    """`lo`, `default`, or the name or address of one network interface.

    ``interface``: `lo` or `localhost`, `default` (what ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE demand, the subnet without
    them), a device or an address; None as `default`, but `lo` where neither variable is set. Raises `TransportError`.
    """
    if interface in _LOOPBACK_NAMES:
        return LOOPBACK
    if interface is None or interface == DEFAULT:
        return _interface_of_environment(environment, unset=LOOPBACK if interface is None else DEFAULT)
    devices = [name for _, name in socket.if_nameindex()]
    if interface not in devices and not _is_address(interface):
        near = difflib.get_close_matches(interface, [*devices, *_LOOPBACK_NAMES, DEFAULT], n=1)
        nearest = f" Did you mean '{near[0]}'?" if near else ""
        raise TransportError(
            f"DDS cannot be used on interface '{interface}': there are {', '.join(devices)}.{nearest} "
            "--interface also takes localhost, default, or an address of this machine."
        )
    return interface


def _interface_of_environment(environment: Mapping[str, str], unset: str) -> str:
    """ROS_LOCALHOST_ONLY goes before ROS_AUTOMATIC_DISCOVERY_RANGE, as in rcl."""
    if environment.get("ROS_LOCALHOST_ONLY") == "1":
        return LOOPBACK
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if not reach:
        return unset
    if reach not in _RANGES:
        near = difflib.get_close_matches(reach, _RANGES, n=1)
        nearest = f" Did you mean {near[0]}?" if near else ""
        raise TransportError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}'; it may be {', '.join(_RANGES)}.{nearest}")
    if reach == "OFF":
        raise TransportError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: no topic can be discovered. Set it to LOCALHOST or SUBNET, or pass --interface."
        )
    return LOOPBACK if reach == "LOCALHOST" else DEFAULT


def configuration(interface: str, environment: Mapping[str, str] = os.environ) -> str:
    """Configuration of a domain for Cyclone DDS: XML fragments, of which later ones overrule earlier ones.

    ``interface`` is one of `choose_interface`. For `default` the user's CYCLONEDDS_URI comes last; the others leave it out, for it may name
    another interface.
    """
    peers = _static_peers(environment)
    if interface == LOOPBACK:
        return _xml("<Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces><AllowMulticast>false</AllowMulticast>", ["127.0.0.1"])
    # A participant with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST on this machine is reached at the loopback address only.
    if interface == DEFAULT:
        uri = environment.get("CYCLONEDDS_URI", "")
        return _xml("", ["localhost", *peers]) + ("," + uri if uri else "")
    chosen = f"address={quoteattr(interface)}" if _is_address(interface) else f"name={quoteattr(interface)}"
    return _xml(f"<Interfaces><NetworkInterface {chosen}/></Interfaces>", peers)


def _xml(general: str, peers: Sequence[str]) -> str:
    listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    discovery = _ASKING + (f"<Peers>{listed}</Peers>" if listed else "")
    parts = f"{_COMPATIBILITY}<General>{general}</General><Discovery>{discovery}</Discovery>{_BUFFER}"
    return f"<CycloneDDS><Domain>{parts}</Domain></CycloneDDS>"


def _static_peers(environment: Mapping[str, str]) -> list[str]:
    """Of ROS_STATIC_PEERS, which are parted by semicolons."""
    return [peer.strip() for peer in environment.get("ROS_STATIC_PEERS", "").split(";") if peer.strip()]


def _is_address(text: str) -> bool:
    for family in (socket.AF_INET, socket.AF_INET6):
        try:
            socket.inet_pton(family, text)
        except OSError:
            continue
        return True
    return False
