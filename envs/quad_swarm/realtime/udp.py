"""Messages over UDP: to each robot's address, or to one multicast group."""

from __future__ import annotations

import ipaddress
import selectors
import socket
from collections.abc import Callable, Mapping

from quad_swarm.realtime.link import Handler, WireLink

Address = tuple[str, int]
_MOST_BYTES = 65535
_AT_ONCE = 1000  # messages handled before the time is looked at again, so that a flood cannot hold up the loop


class UdpLink(WireLink):
    """A link over UDP. Nothing is received from, or sent to, other machines unless addresses say so.

    :ivar address: where this robot receives
    :ivar addresses: where the other robots receive, by their numbers; not needed with a group

    :param index: number of the robot
    :param addresses: where the other robots receive
    :param host: address of the interface to use, by default that of this machine alone
    :param port: port, by default any that is free
    :param group: address and port of a multicast group, to which everything is sent
    :param session: see `WireLink`
    :param checked: see `WireLink`
    :param hops: most networks that multicast messages cross
    :raises ValueError: if the group is no multicast address
    :raises OSError: if the address is not this machine's, or taken
    """

    def __init__(
        self,
        index: int,
        addresses: Mapping[int, Address] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        group: Address | None = None,
        session: int = 0,
        checked: bool = False,
        hops: int = 0,
    ):
        if group is not None:
            check_group(group[0])
        super().__init__(index, session, checked)
        self.addresses, self.group = dict(addresses or {}), group
        self._selector, self._sockets = selectors.DefaultSelector(), list[socket.socket]()
        self._socket = open_socket(host, port)
        self.address: Address = self._socket.getsockname()
        self.watch(self._socket, self._take)
        if group is not None:
            interface = socket.inet_aton(host)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hops)
            listens = open_socket(*group, shared=True)
            member = socket.inet_aton(group[0]) + interface
            listens.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            self.watch(listens, self._take)

    def watch(self, opened: socket.socket, take: Callable[[bytes, Handler], None]) -> None:
        """Receive from another socket, too, while the loop waits.

        :param opened: a socket that does not block
        :param take: what to do with a message
        """
        self._sockets.append(opened)
        self._selector.register(opened, selectors.EVENT_READ, take)

    def wait(self, until: int, handler: Handler, done: Callable[[], bool] = lambda: False) -> None:
        """See `Link`."""
        while True:
            left = max(until - self.now(), 0)
            for key, _ in self._selector.select(left * 1e-6):
                opened = key.fileobj
                assert isinstance(opened, socket.socket)
                for _ in range(_AT_ONCE):
                    try:
                        message = opened.recv(_MOST_BYTES)
                    except BlockingIOError:
                        break
                    except OSError:  # an address to which something was sent is not there any more
                        continue
                    key.data(message, handler)
            if left == 0 or done():
                return

    def transmit(self, other: int, message: bytes) -> None:
        """See `WireLink`.

        :raises KeyError: if the address of the other robot is unknown
        """
        address = self.group or self.addresses[other]
        if other not in self.deaf_to:
            self._socket.sendto(message, address)

    def close(self) -> None:
        """Close the sockets."""
        self._selector.close()
        for opened in self._sockets:
            opened.close()

    def _take(self, data: bytes, handler: Handler) -> None:
        for message in [data] if self.channel is None else self.channel.arriving(data):
            if self.deaf_to and len(message) > 2 and message[2] in self.deaf_to:  # the sender
                continue
            self.deliver(message, handler)


def check_group(address: str) -> None:
    """Check the address of a group.

    :raises ValueError: if it is no multicast address
    """
    if not ipaddress.ip_address(address).is_multicast:
        raise ValueError(f"group: {address} is no multicast address, such as 239.255.77.77")


def open_socket(host: str, port: int, shared: bool = False) -> socket.socket:
    """Open a socket that does not block.

    :param host: address to bind it to
    :param port: port, 0 for any that is free
    :param shared: whether several processes receive there
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if shared:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
        opened.bind((host, port))
        opened.setblocking(False)
    except BaseException:
        opened.close()
        raise
    return opened
