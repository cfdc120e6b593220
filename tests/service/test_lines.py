"""Messages between processes arrive whole and in order, however the bytes arrive."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong_service.lines import LONGEST_LINE, Lines, encode
from sidelong_service.messages import ArmReady, Heartbeat, StopArm


@pytest.fixture
def ends() -> Iterator[tuple[Lines, socket.socket]]:
    """A receiver, and the bare socket of the other side."""
    ours, theirs = socket.socketpair()
    receiver = Lines(ours)
    yield receiver, theirs
    receiver.close()
    theirs.close()


def test_a_message_comes_as_it_was_sent(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    Lines(other).send(ArmReady(name="arm\nwith a line break"))
    assert ArmReady.model_validate_json(receiver.receive(5)).name == "arm\nwith a line break"


def test_two_messages_in_one_packet_are_two(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    other.sendall(encode(Heartbeat()) + encode(StopArm()) + b'{"kind"')
    assert receiver.receive(5) == b'{"kind":"heartbeat"}'
    assert receiver.receive(5) == b'{"kind":"stop"}'
    with pytest.raises(TimeoutError):
        receiver.receive(0.01)


def test_a_message_in_pieces_is_one_and_a_timeout_keeps_what_came(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    for piece in (b'{"kind":', b'"heart', b'beat"}'):
        other.sendall(piece)
        with pytest.raises(TimeoutError, match=r"0\.01 s"):
            receiver.receive(0.01)
    other.sendall(b"\n")
    assert receiver.receive(5) == b'{"kind":"heartbeat"}'


def test_a_timeout_takes_no_longer_than_it_says(ends: tuple[Lines, socket.socket]) -> None:
    started_s = time.monotonic()
    with pytest.raises(TimeoutError):
        ends[0].receive(0.05)
    assert 0.04 < time.monotonic() - started_s < 2.0


def test_what_was_sent_before_the_end_is_received_before_it(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    other.sendall(encode(Heartbeat()) + b"half a mess")
    other.close()
    assert receiver.receive(5) == b'{"kind":"heartbeat"}'
    for _ in range(2):
        with pytest.raises(EOFError, match="gone"):
            receiver.receive(5)


def test_sending_to_one_who_has_gone_is_an_error(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    other.close()
    with pytest.raises(OSError, match="pipe"):
        receiver.send(Heartbeat())


def test_a_reset_connection_is_one_who_has_gone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
    receiver = Lines(near)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    far.close()
    with pytest.raises(EOFError, match="gone"):
        receiver.receive(5)
    receiver.close()


def test_a_receiver_that_waits_can_be_woken(ends: tuple[Lines, socket.socket]) -> None:
    receiver, _ = ends
    threading.Timer(0.05, receiver.end).start()
    with pytest.raises(EOFError):
        receiver.receive(10)


def test_a_line_without_end_is_given_up(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends

    def flood() -> None:
        try:
            for _ in range(LONGEST_LINE // 65536 + 8):
                other.sendall(b"x" * 65536)
        except OSError:
            pass

    sender = threading.Thread(target=flood)
    sender.start()
    with pytest.raises(EOFError):
        receiver.receive(10)
    receiver.close()
    sender.join()


def test_threads_that_send_at_once_do_not_mix_their_messages(ends: tuple[Lines, socket.socket]) -> None:
    receiver, other = ends
    sender = Lines(other)

    def send(name: str) -> None:
        for _ in range(50):
            sender.send(ArmReady(name=name * 3000))

    threads = [threading.Thread(target=send, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    names = [ArmReady.model_validate_json(receiver.receive(10)).name for _ in range(200)]
    for thread in threads:
        thread.join()
    assert sorted(names) == sorted(name * 3000 for name in "abcd" for _ in range(50))


@given(
    names=st.lists(st.text(st.characters(codec="utf-8"), max_size=30), max_size=6), cuts=st.lists(st.integers(1, 40))
)
def test_however_the_bytes_are_cut_the_messages_are_the_same(names: list[str], cuts: list[int]) -> None:
    ours, theirs = socket.socketpair()
    receiver = Lines(ours)
    content = b"".join(encode(ArmReady(name=name)) for name in names)
    for cut in cuts:
        theirs.sendall(content[:cut])
        content = content[cut:]
    theirs.sendall(content)
    theirs.close()
    assert [ArmReady.model_validate_json(receiver.receive(5)).name for _ in names] == names
    with pytest.raises(EOFError):
        receiver.receive(5)
    receiver.close()
