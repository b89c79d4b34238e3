"""``t4nmtd doctor``: diagnoses step by step why a coordinator cannot be reached."""

from __future__ import annotations

import errno
import socket
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from t4nmtd_dist.core.errors import ConfigError, KeyFileError, ProtocolError, RunError
from t4nmtd_dist.core.version import __version__
from t4nmtd_dist.wire.addresses import split_endpoint
from t4nmtd_dist.wire.auth.keys import ClientKeys, load_client
from t4nmtd_dist.wire.endpoints import CONTROL_PORT
from t4nmtd_dist.wire.messages import PROTOCOL_VERSION, DashboardState, Status
from t4nmtd_dist.wire.sockets import receive, subscribe
from t4nmtd_dist.wire.status_client import StatusClient
from t4nmtd_dist.wire.zmq_types import Context, new_context
from t4nmtd_dist.wire.zmtp_probe import Greeting, read_greeting

Verdict = Literal["ok", "warning", "FAILED"]
ROUND_TRIPS = 5
SLOW_S, CLOCK_S = 0.1, 5.0
WELL, UNWELL = 0, 1


@dataclass(frozen=True)
class Finding:
    """The result of one diagnostic step; ``advice`` says how to fix a problem."""

    step: str
    verdict: Verdict
    text: str
    advice: str = ""


def examine(endpoint: str, keys: Path | None, wait_s: float) -> int:
    """Run the diagnosis and print one line per step, up to the first failure.

    Returns:
        0 if the coordinator is usable, else 1.
    """
    worst = WELL
    for finding in findings(endpoint, keys, wait_s):
        print(f"{finding.step + ':':<10}{finding.verdict:<9}{finding.text}")
        if finding.advice:
            print(f"{'':<10}-> {finding.advice}")
        worst = max(worst, UNWELL if finding.verdict == "FAILED" else WELL)
    return worst


def findings(endpoint: str, keys: Path | None, wait_s: float) -> Iterator[Finding]:
    """The diagnostic steps, up to the first failure.

    Args:
        endpoint: the coordinator's control endpoint.
        keys: folder of a client's keys.
        wait_s: timeout of each answer in seconds.
    """
    host, port = split_endpoint(endpoint)
    address = _address(host)
    if isinstance(address, Finding):
        yield address
        return
    yield Finding("name", "ok", f"{host} is {address}")
    reached = _reach(address, int(port), wait_s)
    yield reached
    if reached.verdict == "FAILED":
        return
    own = _own_keys(keys)
    if isinstance(own, Finding):
        yield own
        return
    context = new_context()
    try:
        yield from _talk(context, endpoint, own, wait_s)
    finally:
        context.destroy(0)


def _address(host: str) -> str | Finding:
    try:
        return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])
    except OSError as error:
        advice = "check the spelling, give the address instead, or add the name to /etc/hosts"
        return Finding("name", "FAILED", f"{host} is not known here: {error.strerror}", advice)


def _reach(address: str, port: int, wait_s: float) -> Finding:
    began = time.monotonic()
    try:
        with socket.create_connection((address, port), wait_s) as connection:
            took = time.monotonic() - began
            greeting = read_greeting(connection, wait_s)
    except TimeoutError:
        advice = (
            f"a firewall on the way drops packets, or the machine is off: let TCP port {port} in on {address}, "
            "and try `ping`"
        )
        return Finding("port", "FAILED", f"no answer from {address}:{port} within {wait_s:.0f} s", advice)
    except ConnectionRefusedError:
        return _nothing_listens(address, port, wait_s)
    except OSError as error:
        reason = error.strerror or str(error)
        unreachable = error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH)
        advice = "check the route and the firewall between the machines" if unreachable else "see the error"
        return Finding("port", "FAILED", f"no connection to {address}:{port}: {reason}", advice)
    if greeting is None:
        advice = f"wrong port? The control socket's is {CONTROL_PORT} unless --bind says otherwise"
        return Finding("port", "FAILED", f"what listens at {address}:{port} is no coordinator", advice)
    return Finding("port", "ok", f"{address}:{port} answers after {took * 1000:.1f} ms, {_kind(greeting)}")


def _kind(greeting: Greeting) -> str:
    return "with keys" if greeting.mechanism == "CURVE" else "without keys"


def _nothing_listens(address: str, port: int, wait_s: float) -> Finding:
    text = f"nothing listens at {address}:{port}"
    if port != CONTROL_PORT and _listens(address, CONTROL_PORT, wait_s):
        advice = f"wrong port? Something listens at {address}:{CONTROL_PORT}, the usual one"
    else:
        advice = (
            f"start the coordinator there (t4nmtd-coordinator --bind tcp://{address}:{port} --keys DIR ...); "
            "if it runs, it listens elsewhere: by default on 127.0.0.1 only"
        )
    return Finding("port", "FAILED", text, advice)


def _listens(address: str, port: int, wait_s: float) -> bool:
    try:
        socket.create_connection((address, port), wait_s).close()
    except OSError:
        return False
    return True


def _own_keys(folder: Path | None) -> ClientKeys | Finding | None:
    if folder is None:
        return None
    try:
        return load_client(folder)
    except KeyFileError as error:
        return Finding("key", "FAILED", str(error), "see docs/security.md for how to make keys")


def _talk(context: Context, endpoint: str, own: ClientKeys | None, wait_s: float) -> Iterator[Finding]:
    try:
        client = StatusClient(context, endpoint, own)
    except ConfigError as error:
        yield Finding("key", "FAILED", str(error))
        return
    outcome = client.handshake(wait_s)
    if outcome != "agreed":
        client.close()
        yield _disagreement(context, endpoint, own, wait_s, outcome)
        return
    who = "no key needed" if own is None else f"the key of {own.own.name} is accepted"
    yield Finding("key", "ok", who)
    yield from _question(client, wait_s)
    client.close()


def _disagreement(
    context: Context, endpoint: str, own: ClientKeys | None, wait_s: float, outcome: str | None
) -> Finding:
    """Why the handshake over an established connection failed."""
    if outcome == "refused" and own is not None:
        text = f"the coordinator does not let in the key of {own.own.name} ({own.own.public})"
        return Finding("key", "FAILED", text, "on its machine: t4nmtd keys list DIR; then t4nmtd keys add DIR NAME")
    if outcome == "mechanism" and own is None:
        text = "the coordinator takes only clients with keys"
        return Finding("key", "FAILED", text, "pass --keys DIR with a folder that `t4nmtd keys add` made there")
    if outcome == "mechanism":
        text = "this side has keys, and what listens there has none"
        return Finding("key", "FAILED", text, "start the coordinator with --keys, or leave --keys out on both sides")
    if _publishes(context, endpoint, own, wait_s):
        text = "this is a coordinator's state port, for dashboards"
        return Finding("port", "FAILED", text, f"wrong port: workers need the control port, {CONTROL_PORT} by default")
    if own is not None:
        text = f"what listens there does not have the key {own.server}"
        advice = "coordinator.public in the --keys folder is another coordinator's: get the right one from its machine"
        return Finding("key", "FAILED", text, advice)
    return Finding("port", "FAILED", "what listens there does not take workers", f"wrong port? Usual: {CONTROL_PORT}")


def _publishes(context: Context, endpoint: str, own: ClientKeys | None, wait_s: float) -> bool:
    subscriber = subscribe(context, endpoint, own)
    try:
        envelope = receive(subscriber, wait_s)
    except ProtocolError:
        return True
    finally:
        subscriber.close(0)
    return envelope is not None and isinstance(envelope.message, DashboardState)


def _question(client: StatusClient, wait_s: float) -> Iterator[Finding]:
    trips: list[float] = []
    try:
        for _ in range(ROUND_TRIPS):
            asked_at, began = time.time(), time.monotonic()
            status = client.status(wait_s)
            trips.append(time.monotonic() - began)
    except ProtocolError as error:
        advice = f"run the same version on all machines; here it is {__version__}, protocol {PROTOCOL_VERSION}"
        yield Finding("protocol", "FAILED", f"the other side speaks another protocol: {error}", advice)
        return
    except RunError as error:
        advice = f"the coordinator hangs, or this is another program's port; usual: {CONTROL_PORT}"
        yield Finding("protocol", "FAILED", str(error), advice)
        return
    yield Finding("protocol", "ok", f"version {PROTOCOL_VERSION}; program {status.program} there, {__version__} here")
    yield _clock(status.clock - asked_at - trips[-1] / 2)
    yield _round_trip(trips)
    yield from _critics(status, wait_s)
    text = f"{status.task} seed {status.seed}: {status.phase}, {status.interactions} interactions"
    yield Finding("run", "ok", text)


def _clock(ahead_s: float) -> Finding:
    text = f"the coordinator's is {abs(ahead_s):.2f} s {'ahead' if ahead_s > 0 else 'behind'}"
    if abs(ahead_s) <= CLOCK_S:
        return Finding("clock", "ok", text)
    return Finding("clock", "warning", text, "leases do not depend on it, but logs will not fit together: set up NTP")


def _round_trip(trips: list[float]) -> Finding:
    text = f"{statistics.median(trips) * 1000:.1f} ms, at most {max(trips) * 1000:.1f} ms of {len(trips)}"
    if statistics.median(trips) <= SLOW_S:
        return Finding("latency", "ok", text)
    advice = "peers wait 200 ms for each other's values: expect learners to fall back to their own critics"
    return Finding("latency", "warning", text, advice)


def _critics(status: Status, wait_s: float) -> Iterator[Finding]:
    """Whether this machine reaches the learners' critics."""
    for pid, endpoint in status.critics.items():
        host, port = split_endpoint(endpoint)
        if _listens(host, int(port), wait_s):
            yield Finding("peer", "ok", f"{pid} answers at {host}:{port}")
            continue
        advice = "let that port in on its machine (--critic-port fixes it), or set --host or --advertise there"
        yield Finding("peer", "warning", f"{pid} cannot be reached at {host}:{port}", advice)
