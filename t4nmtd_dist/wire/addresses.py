"""Addresses: which one of this machine's others can use, and where a socket that is bound to all of them is."""

from __future__ import annotations

import socket

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.wire.endpoints import check_endpoint

LOOPBACK = "127.0.0.1"
EVERYWHERE = ("0.0.0.0", "*")


def split_endpoint(endpoint: str) -> tuple[str, str]:
    """Host and port of ``tcp://HOST:PORT``.

    Raises:
        ConfigError: if it is malformed.
    """
    check_endpoint(endpoint)
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    return host.strip("[]"), port


def here(endpoint: str) -> str:
    """How this machine itself reaches what is bound to an endpoint."""
    host, port = split_endpoint(endpoint)
    return f"tcp://{LOOPBACK}:{port}" if host in EVERYWHERE else endpoint


def address_towards(endpoint: str) -> str:
    """This machine's address on its way to an endpoint; nothing is sent.

    Raises:
        ConfigError: if the host's name is unknown, or there is no way to it.
    """
    host, port = split_endpoint(endpoint)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, int(port)))
            return str(probe.getsockname()[0])
    except socket.gaierror:
        raise ConfigError(f"the name {host!r} in {endpoint} is not known here; check it, or give an address") from None
    except OSError as error:
        raise ConfigError(f"no way to {endpoint} from here: {error.strerror}") from None


def critic_endpoints(coordinator: str, host: str, port: int, advertise: str) -> tuple[str, str]:
    """Where a learner binds its critics' socket, and the host under which its peers find it.

    Args:
        coordinator: the coordinator's endpoint.
        host: address to bind; empty for the one on the way to the coordinator.
        port: port to bind; 0 for any free one.
        advertise: host to tell the peers; empty for the bound one, or if that is all of them, the one on the way.

    Raises:
        ConfigError: see ``address_towards``.
    """
    bound = host or address_towards(coordinator)
    told = advertise or (address_towards(coordinator) if bound in EVERYWHERE else bound)
    return f"tcp://{bound}:{port or '*'}", told
