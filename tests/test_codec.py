"""Framing: what goes through the codec comes out the same, and nothing malformed gets further than a ProtocolError."""

from __future__ import annotations

import re
import sys
import time
import unicodedata
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.wire import codec
from t4nmtd_dist.wire.codec import DTYPES, Envelope, decode, encode, with_prefix, without_prefix
from t4nmtd_dist.wire.fields import LARGEST_COUNT, LONGEST_NAME, PRINTABLE, shortened
from t4nmtd_dist.wire.messages import (
    KINDS,
    PROTOCOL_VERSION,
    Claim,
    DashboardState,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    EvaluationRow,
    EventLine,
    ExperienceReply,
    ExperienceRequest,
    Failure,
    Goodbye,
    Granted,
    Intervention,
    LearnerRow,
    LearnerStats,
    Message,
    Notice,
    Peer,
    QCell,
    Refused,
    Release,
    Status,
    StatusRequest,
    Sync,
    SyncReply,
    ValueReply,
    ValueRequest,
    WeightsReply,
    WeightsRequest,
)

STATS = LearnerStats(phase="training", interactions=9, recent_success=0.5, intervention=Intervention(asked=3, late=1))
ROW = EvaluationRow(
    job=1,
    interactions=5,
    elapsed_s=0.5,
    success_rate=1.0,
    mean_length=20.0,
    std_length=0.0,
    mean_return=66.0,
    dfa_path=[0, 1, 5],
)
LEARNER = LearnerRow(
    pid="p1",
    phase="lost",
    worker="host:1",
    epoch=2,
    version=3,
    starts_waiting=9,
    heartbeat_age_s=None,
    total=LearnerStats(interactions=4, gradient_steps=6, attempts=8),
    rates={"interactions": 5.0, "gradient_steps": 7.0},
)
EXAMPLES: list[Message] = [
    Notice(text="worker p1 ended with code 1\nKeyError"),
    Claim(role="learner", instance="host:1", pid="~p1", critic_endpoint="tcp://127.0.0.1:1"),
    Granted(
        role="learner",
        pid="p1",
        epoch=1,
        lease_s=10.0,
        seed=0,
        task={"name": "t", "nested": {"list": [1, 2.5, None]}},
        dfa={"states": 2},
        decomposition={"p1": [[0, 1]]},
        rho=[33.3, 100.0],
    ),
    Refused(reason="stale epoch", text="over", final=True, pid="p1"),
    Sync(pid="p1", epoch=1, sequence=2, version=3, start_cursor=4, stats=STATS),
    SyncReply(
        pid="p1",
        epoch=1,
        accepted_sequence=2,
        start_cursor=4,
        q_table=[(0, "p1", -1.5)],
        peers={"g": Peer(endpoint="tcp://127.0.0.1:1", version=1, epoch=1)},
    ),
    Release(pid="p1", epoch=1),
    EvaluationPoll(epoch=1),
    EvaluationJob(job=1, interactions=2, q_table=[(0, "p1", 1.0)], versions={"p1": 3}),
    EvaluationReport(
        epoch=1, job=1, success_rate=1.0, mean_length=2.0, std_length=0.0, mean_return=3.0, episodes=20, dfa_path=[0, 1]
    ),
    Goodbye(reason="solved"),
    StatusRequest(),
    Status(
        program="0.1.0",
        clock=1.5,
        task="task7",
        seed=0,
        run_dir="",
        phase="training",
        elapsed_s=1.0,
        interactions=2,
        max_interactions=3,
        success_rate=None,
        solved_in_a_row=0,
        solved_needed=5,
        evaluator="",
        learners=[LEARNER],
        critics={"p1": "tcp://127.0.0.1:1"},
    ),
    Failure(text="no"),
    ValueRequest(pid="p1"),
    ValueReply(version=1),
    WeightsRequest(pid="g", newer_than=-1),
    WeightsReply(version=1),
    ExperienceRequest(pid="g", step=5),
    ExperienceReply(first=3, written=9, origin="a1"),
    DashboardState(
        task="task7",
        title="t",
        formula="F(a)",
        run_dir="",
        seed=0,
        phase="training",
        elapsed_s=1.0,
        interactions=2,
        max_interactions=3,
        dfa_states=2,
        accepting=[1],
        error=[],
        dist=[1.0, None],
        solved_in_a_row=0,
        solved_needed=5,
        learners=[LEARNER],
        q_table=[QCell(q=0, pid="p1", value=1.0, greedy=True)],
        evaluations=[ROW],
        events=[EventLine(elapsed_s=0.1, text="began")],
    ),
]

any_array = st.sampled_from(sorted(DTYPES)).flatmap(
    lambda dtype: hnp.arrays(np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
)
printable = st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), max_size=12)
named_arrays = st.dictionaries(st.text(max_size=12), any_array, max_size=4)


def header(**changes: Any) -> bytes:
    """A correct header frame of a ``release`` message but for ``changes``."""
    fields: dict[str, Any] = {
        "v": PROTOCOL_VERSION,
        "kind": "release",
        "sender": "",
        "id": 0,
        "body": {"pid": "p1", "epoch": 1},
        "arrays": [],
    }
    packed: bytes = msgpack.packb({**fields, **changes})
    return packed


def equal(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def test_there_is_an_example_of_every_kind() -> None:
    assert {type(message) for message in EXAMPLES} == set(KINDS.values())


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_every_kind_survives_the_trip(message: Message) -> None:
    assert decode(encode(Envelope(message))) == Envelope(message)


@settings(max_examples=60)
@given(message=st.sampled_from(EXAMPLES), arrays=named_arrays, sender=printable, number=st.integers(0, 2**63 - 1))
def test_any_arrays_survive_the_trip(
    message: Message, arrays: dict[str, NDArray[Any]], sender: str, number: int
) -> None:
    back = decode(encode(Envelope(message, arrays, sender, number)))
    assert (back.message, back.sender, back.id) == (message, sender, number)
    assert list(back.arrays) == list(arrays)
    assert all(equal(back.arrays[name], arrays[name]) for name in arrays)


@settings(max_examples=60)
@given(state=any_array)
def test_arrays_in_any_memory_layout_arrive_in_c_order(state: NDArray[Any]) -> None:
    back = decode(encode(Envelope(Release(pid="p1", epoch=1), {"a": state.T})))
    assert equal(back.arrays["a"], np.ascontiguousarray(state.T).reshape(state.T.shape))


def test_received_arrays_are_read_only() -> None:
    back = decode(encode(Envelope(Release(pid="p1", epoch=1), {"a": np.zeros(2)})))
    with pytest.raises(ValueError, match="read-only"):
        back.arrays["a"][0] = 1.0


@pytest.mark.parametrize("dtype", ["<c8", "<f2", ">f4", "<U3", "<M8[s]", "|O"])
def test_arrays_of_other_types_are_not_sent(dtype: str) -> None:
    with pytest.raises(ProtocolError, match="dtype"):
        encode(Envelope(Release(pid="p1", epoch=1), {"a": np.zeros(1, dtype=dtype)}))


REFUSED_FRAMES: dict[str, tuple[list[bytes], str]] = {
    "no frames": ([], "empty"),
    "not msgpack": ([b"\xc1"], "not msgpack"),
    "cut short": ([header()[:-3]], "not msgpack"),
    "trailing bytes": ([header() + b"\x00"], "not msgpack"),
    "not a map": ([msgpack.packb([1, 2])], "version"),
    "another version": ([header(v=PROTOCOL_VERSION + 1)], "version"),
    "version true": ([header(v=True)], "version True"),
    "unknown header field": ([header(more=1)], "header"),
    "kind is no text": ([header(kind=7)], "header"),
    "unknown kind": ([header(kind="reboot")], "unknown message kind 'reboot'"),
    "missing field": ([header(body={"pid": "p1"})], "epoch"),
    "unknown field": ([header(body={"pid": "p1", "epoch": 1, "x": 2})], "x"),
    "wrong type": ([header(body={"pid": "p1", "epoch": "1"})], "epoch"),
    "bytes as key": ([header(body={b"pid": "p1", "epoch": 1})], "header"),
    "extension type": ([header(body={"pid": msgpack.ExtType(5, b"x"), "epoch": 1})], "pid"),
    "array missing": ([header(arrays=[("a", "<f4", [1])])], "announces 1 arrays and carries 0"),
    "array unannounced": ([header(), b"1234"], "announces 0 arrays and carries 1"),
    "one name twice": ([header(arrays=[("a", "<f4", [1])] * 2), b"1234", b"1234"], "twice"),
    "object array": ([header(arrays=[("a", "|O", [1])]), b"12345678"], "dtype"),
    "big-endian": ([header(arrays=[("a", ">f4", [1])]), b"1234"], "dtype"),
    "too few bytes": ([header(arrays=[("a", "<f4", [2])]), b"1234"], "expected 8"),
    "too many bytes": ([header(arrays=[("a", "<f4", [1])]), b"12345"], "expected 4"),
    "negative side": ([header(arrays=[("a", "<f4", [-1])]), b"1234"], "shape"),
    "two negative sides": ([header(arrays=[("a", "<f4", [-1, -1])]), b"1234"], "shape"),
    "nine dimensions": ([header(arrays=[("a", "<f4", [1] * 9)]), b"1234"], "shape"),
    "nothing, but huge": ([header(arrays=[("a", "<f4", [0, 2**63])]), b""], "shape"),
    "nothing, but of large sides": ([header(arrays=[("a", "<f4", [0, 2**25, 2**25, 2**25])]), b""], "shape"),
}


@pytest.mark.parametrize(("frames", "text"), REFUSED_FRAMES.values(), ids=REFUSED_FRAMES.keys())
def test_malformed_frames_are_refused_with_the_reason(frames: list[bytes], text: str) -> None:
    with pytest.raises(ProtocolError, match=text):
        decode(frames)


@pytest.mark.parametrize(
    ("limit", "most", "text"),
    [("MAX_ARRAY_BYTES", 799, "800 bytes|shape"), ("MAX_HEADER_BYTES", 20, "header of"), ("MAX_ARRAYS", 0, "arrays")],
)
def test_what_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch, limit: str, most: int, text: str) -> None:
    frames = encode(Envelope(Release(pid="p1", epoch=1), {"a": np.zeros(100)}))
    decode(frames)
    monkeypatch.setattr(codec, limit, most)
    with pytest.raises(ProtocolError, match=text):
        decode(frames)


def decodes_or_refuses(frames: list[bytes]) -> None:
    try:
        envelope = decode(frames)
    except ProtocolError:
        return
    assert isinstance(envelope.message, Message)


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=64), max_size=4))
def test_random_bytes_never_crash(frames: list[bytes]) -> None:
    decodes_or_refuses(frames)


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=60)
@given(
    kind=st.sampled_from(sorted(KINDS)),
    body=plain,
    arrays=st.lists(st.tuples(st.text(max_size=3), st.sampled_from([*DTYPES, "|O"]), st.lists(plain, max_size=3))),
    frames=st.lists(st.binary(max_size=16), max_size=3),
)
def test_well_packed_nonsense_never_crashes(kind: str, body: Any, arrays: Any, frames: list[bytes]) -> None:
    decodes_or_refuses([header(kind=kind, body=body, arrays=arrays), *frames])


@settings(max_examples=60)
@given(st.sampled_from([example for example in EXAMPLES if example.__struct_fields__]), st.data())
def test_one_changed_field_never_crashes(message: Message, data: st.DataObject) -> None:
    body = msgspec.to_builtins(message)
    kind = body.pop("type")
    body[data.draw(st.sampled_from(sorted(body)))] = data.draw(plain)
    decodes_or_refuses([header(kind=kind, body=body)])


@pytest.mark.parametrize("depth", [10, 500, 1000, 5000])
def test_deep_nesting_never_crashes(depth: int) -> None:
    body = b"\x81\xa4task" + b"\x91" * depth + b"\x01"
    fields = msgpack.packb({"v": PROTOCOL_VERSION, "kind": "granted", "sender": "", "id": 0, "arrays": []})
    decodes_or_refuses([b"\x86" + fields[1:] + msgpack.packb("body") + body])


HOSTILE_HEADERS = {
    "300,000 sides": header(arrays=[("a", "<f4", [2**63 - 1] * 300_000)]),
    "300,000 arrays": header(arrays=[("a", "<f4", [])] * 300_000),
    "a long dtype": header(arrays=[("a", "<f4" * 300_000, [1])]),
    "a long name": header(arrays=[("a" * 1_000_000, "|O", [1])]),
    "a long kind": header(kind="k" * 1_000_000),
    "a version of many digits": header(v="9" * 1_000_000),
    "a list announced and not sent": b"\xdd\x00\x01\xff\xff" * 900,
    "many fields": header(body={str(number): number for number in range(100_000)}),
    "a deep body": header(body={"pid": "p1"})[:-8] + b"\x91" * 100_000,
}


@pytest.mark.parametrize("frame", HOSTILE_HEADERS.values(), ids=HOSTILE_HEADERS.keys())
def test_hostile_headers_are_refused_quickly_and_in_few_words(frame: bytes) -> None:
    began = time.process_time()
    with pytest.raises(ProtocolError) as refusal:
        decode([frame, b"1234"])
    with pytest.raises(ProtocolError):
        decode([frame, b"1234"], header_bytes=codec.MAX_REQUEST_HEADER_BYTES)
    assert time.process_time() - began < 1.0
    assert len(str(refusal.value)) < 1000


def test_headers_of_requests_are_smaller_than_those_of_answers() -> None:
    long = header(body={"pid": "p1" * codec.MAX_REQUEST_HEADER_BYTES, "epoch": 1})
    with pytest.raises(ProtocolError, match="header of"):
        decode([long], header_bytes=codec.MAX_REQUEST_HEADER_BYTES)


def bodies(message: Message) -> list[tuple[str, ...]]:
    """Paths of all whole numbers in a message's body."""
    found = []
    for name, value in msgspec.to_builtins(message).items():
        if type(value) is int:
            found.append((name,))
        if isinstance(value, dict):
            found += [(name, inner) for inner, number in value.items() if type(number) is int]
    return found


FROM_CLIENTS = (Claim, Sync, Release, EvaluationPoll, EvaluationReport)
FROM_PEERS = (ValueRequest, ValueReply, WeightsRequest, WeightsReply, ExperienceRequest, ExperienceReply)
BOUNDED = [example for example in EXAMPLES if isinstance(example, (*FROM_CLIENTS, *FROM_PEERS))]


def with_field(message: Message, path: tuple[str, ...], value: object) -> bytes:
    body = msgspec.to_builtins(message)
    kind, place = body.pop("type"), body
    for name in path[:-1]:
        place = place[name]
    assert path[-1] in place
    place[path[-1]] = value
    return header(kind=kind, body=body)


@pytest.mark.parametrize("number", [-2, LARGEST_COUNT + 1, 2**64 - 1])
@pytest.mark.parametrize("message", BOUNDED, ids=lambda message: type(message).__name__)
def test_whole_numbers_from_others_are_bounded(message: Message, number: int) -> None:
    for path in bodies(message):
        with pytest.raises(ProtocolError, match="Expected `int`"):
            decode([with_field(message, path, number)])


NOT_FINITE = (float("nan"), float("inf"), -float("inf"), -1e300)
AMOUNTS = {
    Sync: [("stats", "processor_s")],
    EvaluationReport: [(name,) for name in ("success_rate", "mean_length", "std_length", "mean_return", "processor_s")],
}


@pytest.mark.parametrize("number", NOT_FINITE)
@pytest.mark.parametrize("message", [example for example in EXAMPLES if type(example) in AMOUNTS])
def test_amounts_from_others_are_finite(message: Message, number: float) -> None:
    for path in AMOUNTS[type(message)]:
        with pytest.raises(ProtocolError, match="Expected `float`"):
            decode([with_field(message, path, number)])


BAD_NAMES = ["", "a\nb", "\x1b[2J", "p\u202e1", "zero\u200bwidth", "line\u2028end", "n" * (LONGEST_NAME + 1)]
NAMED = [(Claim, "instance"), (Claim, "pid"), (Sync, "pid"), (Release, "pid"), (ValueRequest, "pid")]


@pytest.mark.parametrize(("kind", "field"), NAMED)
@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_would_deceive_or_break_a_terminal_are_refused(kind: type[Message], field: str, name: str) -> None:
    (message,) = [example for example in EXAMPLES if type(example) is kind]
    with pytest.raises(ProtocolError, match="Expected `str`") as refusal:
        decode([with_field(message, (field,), name)])
    assert str(refusal.value).isprintable()


@pytest.mark.parametrize("name", ["p1", "~p1&p2", "a+b_c", "Größe", "目標", "🙂", "host:123", "a b"])
def test_ordinary_names_pass(name: str) -> None:
    (message,) = [example for example in EXAMPLES if isinstance(example, Release)]
    assert decode([with_field(message, ("pid",), name)]).message == Release(pid=name, epoch=1)


@pytest.mark.parametrize("sender", BAD_NAMES[1:])
def test_a_sender_has_a_printable_name(sender: str) -> None:
    with pytest.raises(ProtocolError, match="header"):
        decode([header(sender=sender)])


@pytest.mark.slow
def test_hidden_characters_are_those_that_unicode_calls_so() -> None:
    category = {c: unicodedata.category(c) for c in map(chr, range(sys.maxunicode + 1))}
    refused = {c for c in category if not re.search(PRINTABLE, c)}
    assert {c for c in category if category[c] in ("Cc", "Cf", "Zl", "Zp")} <= refused
    assert {category[c] for c in refused} <= {"Cc", "Cf", "Zl", "Zp", "Cn"}  # Cn: not yet known to this Python


@given(st.text())
def test_a_text_for_people_is_printable_and_short(text: str) -> None:
    assert shortened(text).isprintable()
    assert len(shortened(text * 300)) <= 500


def test_prefixes_come_off_as_they_went_on() -> None:
    arrays = {"weight": np.zeros(1), "bias": np.ones(1)}
    prefixed = with_prefix("weights.", arrays)
    assert set(prefixed) == {"weights.weight", "weights.bias"}
    assert without_prefix("weights.", prefixed | {"other": np.zeros(1)}) == arrays


@pytest.mark.parametrize(
    "arrays",
    [
        {f"a{number}": np.zeros(1, np.float32) for number in range(codec.MAX_ARRAYS + 1)},
        {f"a{number}": np.zeros(codec.MAX_ARRAY_BYTES, np.uint8) for number in range(3)},
    ],
    ids=["too many", "too large together"],
)
def test_what_the_other_side_would_refuse_is_not_sent(arrays: dict[str, NDArray[Any]]) -> None:
    with pytest.raises(ProtocolError, match="a message takes at most"):
        encode(Envelope(Failure(text="x"), arrays))


def test_a_parameter_of_a_sub_task_with_a_long_name_travels() -> None:
    name = f"{'a' * 900}/weights.actor.0.weight"
    assert list(decode(encode(Envelope(Failure(text="x"), {name: np.zeros(1, np.float32)}))).arrays) == [name]
