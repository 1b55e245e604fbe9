"""Slots between processes: whole values or none, whatever happens to the writer."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from deploy.slots import STATE, Board, Slot

ROOT = Path(__file__).parent.parent

# Writes values whose numbers all agree, as fast as it can, until it is killed.
WRITER = """
import sys
import time
from deploy.slots import Board
board = Board(int(sys.argv[1]))
value, n = board.state.blank(), 0
while True:
    n += 1
    value["k"], value["x"], value["u"] = n, n, n
    board.state.write(value)
"""


@pytest.fixture
def board():
    made = Board()
    yield made
    made.close()


def value(board: Board, n: int) -> np.ndarray:
    filled = board.state.blank()
    filled["k"], filled["x"] = n, n
    return filled


def test_the_newest_value_comes_back_and_is_the_readers_own(board):
    assert board.state.read() is None
    for n in (1, 2, 3):
        board.state.write(value(board, n))
        read = board.state.read()
        assert read["k"] == n
        assert (read["x"] == n).all()
    read["k"] = 77
    assert board.state.read()["k"] == 3
    assert board.state.count == 3


def test_another_process_sees_it_through_the_descriptor(board):
    other = Board(os.dup(board.descriptor))
    board.plan.write(board.plan.blank())
    assert other.plan.count == 1
    assert other.state.count == 0  # a slot of its own
    other.close()


def test_a_torn_value_is_not_believed(board):
    """As if the writer had been stopped anywhere inside a write: the value before it is read, or none."""
    board.state.write(value(board, 1))
    board.state.write(value(board, 2))
    before = bytes(board._memory)
    board.state.write(value(board, 3))
    after = bytes(board._memory)
    changed = [i for i in range(len(before)) if before[i] != after[i]]
    turn = range(board.state._offset, board.state._offset + 8)
    body = [i for i in changed if i not in turn]
    assert len(body) > 50
    for stop in range(0, len(body), 3):  # the number that tells the newer buffer is written last
        board._memory[:] = before
        for i in body[:stop]:
            board._memory[i : i + 1] = after[i : i + 1]
        assert board.state.read()["k"] == 2
    board._memory[:] = after
    at = body[len(body) // 2]
    board._memory[at : at + 1] = bytes([after[at] ^ 1])
    assert board.state.read() is None  # a bit of the newer one is wrong


def test_a_value_of_another_layout_is_refused(board):
    with pytest.raises(ValueError, match="octets"):
        board.state.write(board.heart.blank())


def test_readers_of_a_busy_writer_that_is_killed(board):
    command = [sys.executable, "-c", WRITER, str(board.descriptor)]
    with subprocess.Popen(command, cwd=ROOT, pass_fds=[board.descriptor]) as writer:
        seen: list[int] = []
        until = time.monotonic() + 10
        while len(seen) < 500 and time.monotonic() < until:
            read = board.state.read()
            if read is not None:
                assert (read["x"] == read["k"]).all()
                assert (read["u"] == read["k"]).all()
                seen.append(int(read["k"]))
        writer.send_signal(signal.SIGKILL)
    assert len(seen) == 500
    assert seen == sorted(seen)
    last = board.state.read()
    assert last is not None
    assert (last["x"] == last["k"]).all()
    board.state.write(value(board, 5))  # a new writer goes on where it was
    assert board.state.read()["k"] == 5


def test_once_there_is_a_value_a_reader_always_finds_one(board):
    """A reader that looks as often as it can, while a value is replaced some thousand times a second."""
    board.state.write(value(board, 0))
    command = [
        sys.executable,
        "-c",
        WRITER.replace("    n +=", "    time.sleep(1e-4)\n    n +="),
        str(board.descriptor),
    ]
    with subprocess.Popen(command, cwd=ROOT, pass_fds=[board.descriptor]) as writer:
        slot, counts, nothing, until = board.state, [1], 0, time.monotonic() + 10
        while counts[-1] < 4000 and time.monotonic() < until:
            counts.append(slot.count)
            nothing += slot.read() is None
        writer.kill()
    assert counts[-1] >= 4000
    assert counts == sorted(counts)
    assert nothing == 0


def test_sizes_are_whole_cache_lines():
    assert Slot.size(STATE) % 64 == 0
    assert Slot.size(STATE) >= 2 * STATE.itemsize
