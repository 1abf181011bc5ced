"""network: which interface a bus uses, asked of the kernel; signing: who may speak; in namespaces of their own."""

import subprocess
import sys
import textwrap

import pytest
from test_twin import SPACE, needs_space

from valve_drake.checks import ConfigError
from valve_drake.stations.network import group_of, interface_of

GROUP = "239.255.76.67"


# ---------------------------------------------------------------- the url


def test_a_url_names_its_group_and_port():
    assert group_of(f"udpm://{GROUP}:7667?ttl=0&recv_buf_size=2097152") == (GROUP, 7667)
    assert group_of("memq://") is None


@pytest.mark.parametrize(
    "url",
    [
        "udpm://nonsense",
        "udpm://",
        "udpm://10.0.0.1:7667",  # no multicast group
        f"udpm://{GROUP}",
        f"udpm://{GROUP}:0",
        f"udpm://{GROUP}:99999",
        f"udpm://{GROUP}:7667?ttl=900",
        f"udpm://{GROUP}:7667?ttl=-1",
        f"udpm://{GROUP}:7667?ttl",
        f"udpm://{GROUP}:7667?tll=0",
        f"udpm://{GROUP}:7667/path",
        "udpm://[::1]:7667",
        "udpm://[",
        "http://x",
        "",
    ],
)
def test_a_url_that_lcm_would_not_serve_is_refused_in_one_line(url):
    with pytest.raises(ConfigError, match=r"hardware\.lcm_url must be ") as caught:
        group_of(url)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- the route


def test_the_kernel_says_where_an_address_is_routed():
    assert interface_of("127.0.0.1") == "lo"


LAN = """
ip link set lo up
ip link add v0 type veth peer name v1
ip addr add 10.9.9.1/24 dev v0
ip link set v0 up
ip link set v1 up
"""
ASK = "from valve_drake.stations.network import check_route; check_route('udpm://239.255.76.67:7667', '{}')"


def in_space(shell: str, code: str) -> str:
    """Runs Python in a network namespace -> the last line of standard error, or ""."""
    script = shell + '\nexec "$0" -c "$1"'
    done = subprocess.run([*SPACE[:2], "sh", "-ec", script, sys.executable, code], capture_output=True, text=True)
    return (done.stderr.strip().splitlines() or [""])[-1] + done.stdout


@needs_space
def test_a_group_that_is_routed_to_the_lan_is_refused_with_the_way_out_unless_it_is_named():
    lan = LAN + "ip route add 224.0.0.0/4 dev v0\n"
    words = in_space(lan, ASK.format("lo"))
    assert all(w in words for w in ("is routed to v0", f"ip route add {GROUP}/32 dev lo", "hardware.network=v0"))
    assert in_space(lan, ASK.format("v0")) == ""


@needs_space
def test_a_route_to_the_loopback_is_one_though_the_kernel_would_send_from_another_address():
    assert in_space(LAN + "ip route add 224.0.0.0/4 dev lo\n", ASK.format("lo")) == ""
    both = LAN + f"ip route add 224.0.0.0/4 dev v0\nip route add {GROUP}/32 dev lo\n"
    assert in_space(both, ASK.format("lo")) == ""


@needs_space
def test_a_group_without_a_route_is_refused():
    assert "is routed nowhere" in in_space("ip link set lo up", ASK.format("lo"))


# Another program of this machine has joined the group on the LAN, before the route led to the loopback.
EAVESDROPPER = f"""
import socket, subprocess, sys
from valve_drake.stations.network import only_own_groups
def bound(interface):
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    s.bind(("{GROUP}", 7667))
    s.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton("{GROUP}") + socket.inet_aton(interface))
    s.settimeout(0.3)
    return s
other, ours = bound("10.9.9.1"), bound("0.0.0.0")
OWN
subprocess.run(sys.argv[1:], check=True)
assert other.recv(99) == b"drive"
try:
    print("heard", ours.recv(99))
except TimeoutError:
    print("silence")
"""
SEND = f"""
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.sendto(b"drive", ("{GROUP}", 7667))
"""


@needs_space
@pytest.mark.parametrize(
    ("own", "heard"), [("", "heard"), ("only_own_groups(7667)", "silence")], ids=["as it is", "mended"]
)
def test_what_comes_in_by_the_lan_is_not_heard_though_another_program_has_joined_the_group_there(own, heard):
    script = """
    ip link set lo up; ip link add v0 type veth peer name v1
    unshare -n sleep 20 & other=$!
    trap "kill $other" EXIT
    until [ "$(readlink /proc/$other/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.02; done
    ip link set v1 netns $other
    ip addr add 10.9.9.1/24 dev v0; ip link set v0 up
    nsenter -t $other -n sh -c 'ip addr add 10.9.9.2/24 dev v1; ip link set v1 up; ip route add 224.0.0.0/4 dev v1'
    ip route add 224.0.0.0/4 dev lo
    "$0" -c "$1" nsenter -t $other -n "$0" -c "$2"
    """
    code = EAVESDROPPER.replace("OWN", own)
    command = [*SPACE[:2], "sh", "-ec", textwrap.dedent(script), sys.executable, code, SEND]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.startswith(heard), done.stderr
