"""Local addresses: how other machines reach this one."""

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
    """The endpoint by which this machine reaches what is bound to ``endpoint``."""
    host, port = split_endpoint(endpoint)
    return f"tcp://{LOOPBACK}:{port}" if host in EVERYWHERE else endpoint


def address_towards(endpoint: str) -> str:
    """This machine's address on the route to an endpoint; sends nothing.

    Raises:
        ConfigError: if the host name is unknown, or there is no route.
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
    """The endpoint where a learner binds its critic socket, and the host it advertises to peers.

    Args:
        coordinator: the coordinator's endpoint.
        host: address to bind; empty for the one on the route to the coordinator.
        port: port to bind; 0 for any free one.
        advertise: advertised host; empty for the bound address, or the one on the route if bound to all interfaces.

    Raises:
        ConfigError: see ``address_towards``.
    """
    bound = host or address_towards(coordinator)
    told = advertise or (address_towards(coordinator) if bound in EVERYWHERE else bound)
    return f"tcp://{bound}:{port or '*'}", told
