"""docs/protocol.md says what wire.messages and wire.codec do: every kind, every field, every limit."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import msgspec
import pytest

from coordinator.service import PUBLISH_S
from t4nmtd_dist.wire import codec, endpoints, limits, messages
from workers.evaluation_work import POLL_S
from workers.worker import SYNC_INTERVAL_S

DOCUMENT = (Path(__file__).parent.parent / "docs" / "protocol.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `(\w+)` \|", re.MULTILINE)


def sections(text: str) -> dict[str, str]:
    """Text below every third-level heading, up to the next heading."""
    return dict(re.findall(r"^### (\S+)\n(.*?)(?=^##|\Z)", text, re.MULTILINE | re.DOTALL))


def documented() -> dict[str, type[messages.Message]]:
    """Every message by kind, and every part of a message by its class's name."""
    structs = [kind for _, kind in inspect.getmembers(messages, inspect.isclass) if issubclass(kind, messages.Message)]
    named = {str(kind.__struct_config__.tag or kind.__name__): kind for kind in structs}
    del named["Message"]
    return named


def array_names(kind: type[messages.Message]) -> list[str]:
    """Names of arrays in a message's docstring: ``like.this`` after the word arrays."""
    _, _, listed = (kind.__doc__ or "").partition("arrays:")
    named: list[str] = re.findall(r"``([\w.<>/*]+)``", listed)
    return [name for name in named if name not in kind.__struct_fields__]


def test_every_kind_and_part_has_a_section_and_no_section_is_left_over() -> None:
    assert set(sections(DOCUMENT)) == set(documented())
    assert set(messages.KINDS) <= set(documented())


@pytest.mark.parametrize("name", documented())
def test_a_section_lists_exactly_the_fields_in_their_order(name: str) -> None:
    assert tuple(ROW.findall(sections(DOCUMENT)[name])) == documented()[name].__struct_fields__


@pytest.mark.parametrize("name", documented())
def test_a_section_names_the_arrays_and_allowed_words(name: str) -> None:
    section = sections(DOCUMENT)[name]
    kind = documented()[name]
    assert [array for array in array_names(kind) if f"`{array}`" not in section] == []
    choices = msgspec.inspect.type_info(kind)
    assert isinstance(choices, msgspec.inspect.StructType)
    words = [
        str(word)
        for field in choices.fields
        if isinstance(field.type, msgspec.inspect.LiteralType) and not (name == "LearnerRow" and field.name == "phase")
        for word in field.type.values
    ]
    assert [word for word in words if f"`{word}`" not in section] == []


def array_shapes(kind: type[messages.Message]) -> set[str]:
    """Types and shapes of arrays in a message's docstring, such as float32 [k, d]."""
    _, _, listed = (kind.__doc__ or "").partition("arrays:")
    return set(re.findall(r"\w+\d+ \[[^\]]+\]", listed))


@pytest.mark.parametrize("name", documented())
def test_a_section_gives_arrays_the_shapes_of_the_docstring(name: str) -> None:
    assert [shape for shape in array_shapes(documented()[name]) if shape not in sections(DOCUMENT)[name]] == []


def test_shapes_are_found_in_docstrings() -> None:
    assert array_shapes(messages.ValueReply) == {"float32 [k]", "float32 [k, 2]"}


def test_intervals_are_those_of_the_program() -> None:
    poll = sections(DOCUMENT)["evaluation_poll"]
    interval = f"{POLL_S} s after each answer while idle"
    assert interval in poll
    assert interval in (messages.EvaluationPoll.__doc__ or "")
    assert f"every {SYNC_INTERVAL_S} s once the one before has been answered" in sections(DOCUMENT)["sync"]
    assert f"every {PUBLISH_S} s" in sections(DOCUMENT)["dashboard_state"]


def test_arrays_are_found_in_docstrings() -> None:
    assert array_names(messages.Sync) == [
        "progress.q", "progress.reward", "starts.q", "starts.state", "weights.*",
    ]  # fmt: skip


def test_the_header_is_described_key_by_key() -> None:
    _, _, framing = DOCUMENT.partition("\n## Framing\n")
    assert tuple(ROW.findall(framing.partition("\n## ")[0])) == codec.Header.__struct_fields__


@pytest.mark.parametrize("name", [name for name in dir(codec) if name.startswith("MAX_")])
def test_limits_are_those_of_the_codec(name: str) -> None:
    (row,) = [line for line in DOCUMENT.splitlines() if line.endswith(f"| `{name}` |")]
    assert re.search(rf"\| {getattr(codec, name):,}\b", row)


@pytest.mark.parametrize(
    ("socket", "of"),
    [("control", limits.CONTROL_LIMITS), ("critic", limits.CRITIC_LIMITS), ("state", limits.STATE_LIMITS)],
)
def test_limits_of_sockets_are_those_of_the_program(socket: str, of: limits.Limits) -> None:
    (row,) = re.findall(rf"^\| {socket}[^|]*\| ([\d,]+) bytes \|(.*)\|$", DOCUMENT, re.MULTILINE)
    numbers = [int(number.replace(",", "")) for number in re.findall(r"[\d,]+", " ".join(row))]
    assert numbers == [of.frame_bytes, of.messages_per_s, of.bytes_per_s, of.unread_bytes, of.connections]


def test_dtypes_defaults_and_version_are_those_of_the_program() -> None:
    _, _, dtypes = DOCUMENT.partition("Allowed dtypes:")
    assert set(re.findall(r"`([<|]\w\d)`", dtypes.partition("There are")[0])) == codec.DTYPES
    assert f"# The wire protocol, version {messages.PROTOCOL_VERSION}\n" in DOCUMENT
    assert f"`{endpoints.DEFAULT_CONTROL}`" in DOCUMENT
    assert f"`{endpoints.DEFAULT_STATE}`" in DOCUMENT
