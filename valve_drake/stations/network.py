"""Where the bus goes: the multicast group of `hardware.lcm_url`, and the interface that the kernel routes it to.

A time to live of 0 keeps what we send on this machine, and says nothing of what comes in: LCM joins its group on the
interface of the route, and takes from there what anybody sends. So the route is looked up before a bus is opened, and
it must lead to the interface that the scenario names: the loopback, unless a lab says otherwise.
"""

import ipaddress
import os
import re
import socket
import stat
import struct
from urllib.parse import parse_qsl, urlsplit

from valve_drake.checks import ConfigError, require, shown

LOOPBACK = "lo"
OPTIONS = {"ttl": 255, "recv_buf_size": 2**30}  # of LCM's udpm, with the largest value
NAME = re.compile(r"[^\s/]{1,15}")  # of a Linux interface

_GET_ROUTE, _ERROR, _DESTINATION, _INTERFACE = 26, 2, 1, 4  # of netlink: RTM_GETROUTE, NLMSG_ERROR, RTA_DST, RTA_OIF
_HEADER, _ROUTE = struct.Struct("=IHHII"), struct.Struct("=BBBBBBBBI")  # nlmsghdr, rtmsg
_ALL_GROUPS = 49  # IP_MULTICAST_ALL


def group_of(url: str) -> tuple[str, int] | None:
    """(multicast address, port) of an LCM url; None for a bus within the process (memq).

    Raises ConfigError: LCM itself only writes a line and stays silent for ever.
    """
    key, rule = "hardware.lcm_url", "udpm://GROUP:PORT[?ttl=N&recv_buf_size=N] with a multicast group, or memq://"
    try:
        parts = urlsplit(url)
        if parts.scheme == "memq":
            return None
        options = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
        group, port = ipaddress.IPv4Address(parts.hostname or ""), parts.port
    except ValueError:
        raise ConfigError(f"{key} must be {rule}, got {shown(url)}") from None
    require(parts.scheme == "udpm" and group.is_multicast and bool(port), key, rule, url)
    require(not (parts.path or parts.fragment or parts.username), key, rule, url)
    for name, value in options:
        require(name in OPTIONS, key, f"with no other option than {' and '.join(OPTIONS)}", url)
        good = value.isascii() and value.isdigit() and int(value) <= OPTIONS[name]
        require(good, key, f"with {name} within [0, {OPTIONS[name]}]", url)
    return str(group), int(port or 0)


def interface_of(address: str) -> str:
    """The interface that the kernel routes an IPv4 address to; "" if it has no route.

    The kernel is asked, as it is when LCM joins a group. The source address that it would choose tells nothing: for a
    route to the loopback it may be another interface's. Raises OSError where this is not Linux.
    """
    body = _ROUTE.pack(socket.AF_INET, 32, 0, 0, 0, 0, 0, 0, 0)
    body += struct.pack("=HH4s", 8, _DESTINATION, socket.inet_aton(address))
    family, protocol = getattr(socket, "AF_NETLINK", None), getattr(socket, "NETLINK_ROUTE", 0)
    if family is None:
        raise OSError("no netlink on this system")
    with socket.socket(family, socket.SOCK_RAW, protocol) as kernel:
        kernel.settimeout(2.0)
        kernel.send(_HEADER.pack(_HEADER.size + len(body), _GET_ROUTE, 1, 1, 0) + body)
        answer = kernel.recv(65536)
    if _HEADER.unpack_from(answer)[1] == _ERROR:
        return ""
    at = _HEADER.size + _ROUTE.size
    while at + 4 <= len(answer):
        size, kind = struct.unpack_from("=HH", answer, at)
        if kind == _INTERFACE:
            return socket.if_indextoname(struct.unpack_from("=I", answer, at + 4)[0])
        at += max((size + 3) & ~3, 4)
    return ""


def check_route(url: str, network: str) -> None:
    """Raises ConfigError unless the url's group is routed to the interface `network`, in a line that says how."""
    target = group_of(url)
    if target is None:
        return
    group, _ = target
    try:
        found = interface_of(group)
    except OSError as error:
        raise ConfigError(f"where {group} is routed cannot be told ({error}): hardware.lcm_url needs Linux") from error
    if found == network:
        return
    there = f"to {found}" if found else "nowhere"
    other = f"; or --set hardware.network={found}, where others may hear and speak" if found else ""
    raise ConfigError(
        f"hardware.network is {shown(network)}, but {group} of hardware.lcm_url is routed {there}: "
        f"`ip route add {group}/32 dev {network}` mends it{other}"
    )


def only_own_groups(port: int) -> None:
    """Makes this process's UDP sockets on `port` take only what comes in where they have joined their group.

    By default Linux also hands them what came for the group on any interface where another program has joined it.
    """
    for name in os.listdir("/proc/self/fd"):
        try:
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            borrowed = socket.socket(fileno=int(name))
        except OSError:  # closed meanwhile
            continue
        try:
            udp = (borrowed.family, borrowed.type) == (socket.AF_INET, socket.SOCK_DGRAM)
            if udp and borrowed.getsockname()[1] == port:
                borrowed.setsockopt(socket.IPPROTO_IP, _ALL_GROUPS, 0)
        finally:
            borrowed.detach()  # it is LCM's
