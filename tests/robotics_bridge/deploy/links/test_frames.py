"""The layout of datagrams, and that nothing but an untouched one with the right key is read."""

from __future__ import annotations

import hashlib
import hmac
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import DataError
from robotics_bridge.deploy.links import frames
from robotics_bridge.deploy.links.frames import (
    COMMAND,
    Frame,
    Receiver,
    SequenceWindow,
    decode,
    encode,
    new_key,
    pack_values,
    read_key,
)

KEY = bytes(range(32))


@given(st.binary(max_size=200))
def test_no_datagram_breaks_the_reader(data) -> None:
    assert decode(data, KEY) is None


@given(st.integers(0, 12), st.integers(0, 5), st.data())
def test_frames_survive_the_way_and_every_change_is_noticed(joints, fingers, data) -> None:
    values = np.arange(2 * joints + 3 * fingers, dtype=np.float32)
    sent = encode(Frame(frames.STATE, joints, fingers, 7, 1.5, pack_values(values)), KEY)
    frame = decode(sent, KEY)
    assert frame is not None
    assert (frame.sequence, frame.time) == (7, 1.5)
    np.testing.assert_array_equal(frame.values, values)
    place = data.draw(st.integers(0, len(sent) - 1))
    damaged = bytearray(sent)
    damaged[place] ^= data.draw(st.integers(1, 255))
    for changed in (bytes(damaged), sent[:place], sent + sent[: place + 1], sent[place:] + sent[:place][1:]):
        assert changed == sent or decode(changed, KEY) is None
    assert decode(sent, new_key()) is None


def test_a_frame_ends_with_the_standard_hmac_of_the_rest() -> None:
    sent = encode(Frame(frames.COMMAND, 1, 0, 1 << 32, 2.0, frames.pack_command([0.5], 7, 2.25)), KEY)
    # RFC 2104 by its definition: H(key ⊕ opad ‖ H(key ⊕ ipad ‖ text)).
    padded = KEY.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + sent[:-32]).digest()
    assert sent[-32:] == hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()
    assert sent[8:12] == bytes(4)  # the number goes on from 0
    frame = decode(sent, KEY)
    assert (frame.origin, frame.values.tolist()) == ((7, 2.25), [0.5])
    # Ends of an earlier version get no answer.
    assert decode(sent.replace(b"BBH3", b"BBH2")[:-32], KEY) is None


@pytest.mark.parametrize("time", [np.nan, np.inf])
@pytest.mark.parametrize("kind", [0, frames.STATE, 77, 255])
def test_authentic_frames_of_no_known_form_are_not_read(kind, time) -> None:
    for body in (b"", bytes(4), bytes(5000)):
        assert decode(encode(Frame(kind, 1, 1, 0, time, body), KEY), KEY) is None


def test_sessions_and_directions_have_keys_of_their_own() -> None:
    nonces = [bytes([number]) * frames.NONCE for number in range(3)]
    found = {key for a in nonces for b in nonces for key in frames.session_keys(KEY, a, b)}
    assert len(found) == 18
    assert hmac.compare_digest(frames.session_keys(KEY, *nonces[:2])[0], frames.session_keys(KEY, *nonces[:2])[0])


def test_a_key_is_read_from_a_private_file(tmp_path) -> None:
    path = tmp_path / "hand.key"
    with pytest.raises(FileNotFoundError, match=r"hand\.key"):
        read_key(path)
    for text in ("", "12", "zz" * 32, "00" * 33, "é" * 64):
        path.write_text(text, encoding="utf-8")
        path.chmod(0o600)
        with pytest.raises(DataError, match=r"hand\.key"):
            read_key(path)
    path.write_text(f"{KEY.hex()}\n")
    assert read_key(path) == KEY
    path.chmod(0o644)
    if os.name == "posix":
        with pytest.raises(DataError, match="chmod 600"):
            read_key(path)


@pytest.mark.parametrize("first", [0, 1, 5000, (1 << 32) - 300, (1 << 32) - 1])
def test_numbers_are_judged_as_a_list_of_all_of_them_would(first) -> None:
    random = np.random.default_rng(first % 97)
    window, seen, newest, lost, gaps = SequenceWindow(), set(), None, 0, []
    for _ in range(3000):
        # Without wrap-around, and with a memory of everything: what the window must agree with.
        number = (newest if newest is not None else first) + int(random.integers(-1200, 30))
        number = max(number, first)
        if newest is None or number > newest:
            expected = "new"
            gaps.append(0 if newest is None else number - newest - 1)
        elif newest - number >= SequenceWindow.SIZE:
            expected = "stale"
        else:
            expected = "replayed" if number in seen else "late"
        verdict, skipped = window.judge(number % (1 << 32))
        assert verdict == expected
        lost += skipped
        seen.add(number)
        newest = number if newest is None else max(newest, number)
    assert lost == sum(gaps)


def test_a_jump_by_half_of_all_numbers_takes_no_memory_and_no_number_from_behind() -> None:
    window = SequenceWindow()
    window.judge(0)
    assert window.judge((1 << 31) - 1) == ("new", (1 << 31) - 2)
    assert window.judge(0)[0] == "stale"
    assert window.judge((1 << 31) - 1)[0] == "replayed"
    assert window.judge((1 << 31) - 2)[0] == "late"


def test_old_frames_are_stale_although_their_number_is_new() -> None:
    receiver = Receiver(b"")

    def judge(number, sent, arrived):
        return receiver.judge(Frame(COMMAND, 1, 0, number, sent), arrived)[0]

    assert judge(1, 10.0, 500.0) == "new"
    assert judge(2, 10.1, 500.2) == "new"
    assert judge(3, 10.2, 500.5) == "stale"
    assert judge(4, 10.6, 500.6) == "new"
    # All numbers were used once: one that comes back is new again by number, and old by time.
    for number in (0x5000_0000, 0xA000_0000, 0xF000_0000, 1):
        verdict = judge(number, 10.61 if number == 1 else 10.6, 500.6 if number != 1 else 900.0)
    assert verdict == "stale"
