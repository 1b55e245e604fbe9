"""The command line: nothing that a user says is dropped without a word."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from hmc.cli import command_line


@dataclass(frozen=True)
class Args:
    """Of a program.

    Attributes:
        seed: a number.
        set: overrides.
        video: a switch.
    """

    seed: int = 0
    set: tuple[str, ...] = ()
    video: bool = True


def test_an_option_that_comes_again_takes_all_of_its_values():
    words = ["--set", "a=1", "b=2", "--seed", "-3", "--set=c=4", "--no-video", "--set", "d=5"]
    assert command_line(Args, words) == Args(seed=-3, set=("a=1", "b=2", "c=4", "d=5"), video=False)
    assert command_line(Args, []) == Args()
    assert command_line(Args, ["--set"]) == Args()


def test_one_value_is_not_two(capsys):
    with pytest.raises(SystemExit):
        command_line(Args, ["--seed", "1", "--seed", "2"])
    assert "2" in capsys.readouterr().err


def test_words_without_an_option():
    def add(first: int, second: int, /, times: int = 1) -> int:
        return times * (first + second)

    assert command_line(add, ["1", "2"]) == 3
    assert command_line(add, ["--times", "2", "1", "2"]) == 6
