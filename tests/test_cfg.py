"""Experiment files: what is read is what was written, and every mistake says where and what."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmc.cfg import CfgError, digest, dump, load, override


@dataclass(frozen=True)
class Term:
    name: str
    weight: float = 1.0


@dataclass(frozen=True)
class Ppo:
    lr: float
    epochs: int = 5
    hidden: tuple[int, ...] = (512, 256, 128)
    clip: float | None = None

    def __post_init__(self) -> None:
        if self.epochs < 1:
            raise ValueError(f"epochs must be at least 1, got {self.epochs}")


@dataclass(frozen=True)
class Experiment:
    ppo: Ppo
    seed: int
    engine: Literal["auto", "mujoco", "warp"] = "auto"
    resume: bool = False
    note: str = ""
    range: tuple[float, float] = (-1.0, 1.0)
    terms: tuple[Term, ...] = ()
    warm: Ppo = Ppo(lr=0.5, epochs=2)
    extra: Term | None = None


GOOD = 'seed = 3\n[ppo]\nlr = 1e-4\n[[terms]]\nname = "pose"\n'
EXPECTED = Experiment(ppo=Ppo(lr=1e-4), seed=3, terms=(Term("pose"),))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "walk.toml"
    path.write_text(GOOD)
    return path


def message(path: Path, text: str) -> str:
    """What `load` says about a file with this text, after the file's name."""
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CfgError) as caught:
        load(path, Experiment)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)[len(str(path)) :]


def test_reads_nested_values_and_keeps_defaults(file):
    assert load(file, Experiment) == EXPECTED


def test_int_becomes_float_where_a_float_is_expected(file):
    file.write_text(GOOD.replace("seed = 3", "seed = 3\nrange = [-2, 2]"))
    values = load(file, Experiment).range
    assert values == (-2.0, 2.0)
    assert all(type(v) is float for v in values)


def test_a_table_changes_the_default_key_by_key(file):
    file.write_text(GOOD + "[warm]\nclip = 0.2\n")
    assert load(file, Experiment).warm == Ppo(lr=0.5, epochs=2, clip=0.2)


def test_a_table_of_a_file(file):
    assert load(file, Ppo, table="ppo") == Ppo(lr=1e-4)
    assert load(file, Ppo, ("epochs=4",), table="ppo") == Ppo(lr=1e-4, epochs=4)
    for name in ("ppoo", "seed"):
        with pytest.raises(CfgError, match=rf"has no table \[{name}\]; it has seed, ppo, terms"):
            load(file, Ppo, table=name)


numbers = st.floats(allow_nan=False)
terms = st.builds(Term, name=st.text(), weight=numbers)
ppos = st.builds(
    Ppo,
    lr=numbers,
    epochs=st.integers(min_value=1),
    hidden=st.lists(st.integers()).map(tuple),
    clip=st.none() | numbers,
)
experiments = st.builds(
    Experiment,
    ppo=ppos,
    seed=st.integers(),
    engine=st.sampled_from(["auto", "mujoco", "warp"]),
    resume=st.booleans(),
    note=st.text(),
    range=st.tuples(numbers, numbers),
    terms=st.lists(terms, max_size=3).map(tuple),
    warm=ppos,
    extra=st.none() | terms,
)


@given(experiments)
def test_dump_then_load_is_the_identity(tmp_path_factory, cfg):
    path = tmp_path_factory.getbasetemp() / "dump.toml"
    path.write_text(dump(cfg), encoding="utf-8", newline="")
    again = load(path, Experiment)
    assert again == cfg
    assert digest(again) == digest(cfg)


@given(experiments, experiments)
def test_digest_differs_exactly_where_values_do(a, b):
    assert (digest(a) == digest(b)) == (a == b)
    assert digest(a) != digest(replace(a, seed=a.seed + 1))


def test_dump_is_canonical():
    """Hand-written: the text, and so the hash in a policy file, must not move between versions."""
    assert dump(Experiment(ppo=Ppo(lr=1, clip=0.2), seed=3, note='a "b"\n', terms=(Term("pose"),))) == (
        'engine = "auto"\n'
        'note = "a \\"b\\"\\n"\n'
        "ppo.clip = 0.2\n"
        "ppo.epochs = 5\n"
        "ppo.hidden = [512, 256, 128]\n"
        "ppo.lr = 1.0\n"
        "range = [-1.0, 1.0]\n"
        "resume = false\n"
        "seed = 3\n"
        'terms = [{name = "pose", weight = 1.0}]\n'
        "warm.epochs = 2\n"
        "warm.hidden = [512, 256, 128]\n"
        "warm.lr = 0.5\n"
    )
    assert digest(Term("pose", 1)) == digest(Term("pose", 1.0))
    assert digest(Term("pose", -0.0)) == digest(Term("pose", 0.0))


def test_dump_refuses_a_none_that_would_be_read_as_something_else():
    @dataclass(frozen=True)
    class Odd:
        x: float | None = 1.0

    Odd.__annotations__["x"] = float | None  # a local class: its names are not looked up
    with pytest.raises(TypeError, match="None"):
        dump(Odd(x=None))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (GOOD.replace("lr", "lrr"), ["unknown key ppo.lrr", "did you mean lr?", "epochs"]),
        (GOOD.replace("seed = 3", "seed = 3\nsede = 4"), ["unknown key sede", "did you mean seed?"]),
        (GOOD.replace("name", "nam"), ["unknown key terms[0].nam", "did you mean name?"]),
        ("[ppo]\nlr = 1.0\n", ["missing seed", "expected int"]),
        ("seed = 3\n", ["missing ppo.lr", "expected float"]),
        (GOOD.replace("1e-4", '"fast"'), ["ppo.lr", "expected float", 'got str "fast"']),
        (GOOD.replace("1e-4", "true"), ["ppo.lr", "expected float", "got bool true"]),
        (GOOD.replace("1e-4", "nan"), ["ppo.lr", "expected float", "NaN"]),
        (GOOD.replace("seed = 3", "seed = 3.0"), ["seed", "expected int", "got float 3.0"]),
        (GOOD.replace("seed = 3", "seed = true"), ["seed", "expected int", "got bool true"]),
        (GOOD.replace("seed", "seed = 3\nresume"), ["resume", "expected bool", "got int 3"]),
        (
            'engine = "mujco"\n' + GOOD,
            ["engine", 'one of "auto", "mujoco", "warp"', 'got str "mujco"', "did you mean mujoco?"],
        ),
        ("range = [1.0]\n" + GOOD, ["range", "list [float, float]", "got list [1.0]"]),
        ('range = [1.0, "b"]\n' + GOOD, ["range[1]", "expected float", 'got str "b"']),
        ("ppo = 3\nseed = 3\n", ["ppo", "expected table of lr, epochs, hidden, clip", "got int 3"]),
        ("seed = 3\n[ppo]\nlr = 1\nhidden = 64\n", ["ppo.hidden", "list of int", "got int 64"]),
        ("seed = 3\n[ppo]\nlr = 1\nepochs = 0\n", [": ppo: epochs must be at least 1, got 0"]),
        ("seed = 3\n[ppo]\nlr = = 1\n", [":3:", "not valid TOML"]),
        ('seed = 3\nnote = "', [":2:", "not valid TOML"]),
    ],
)
def test_errors_name_the_file_the_key_and_both_sides(file, text, parts):
    said = message(file, text)
    for part in parts:
        assert part in said


def test_missing_file_names_its_neighbours(file):
    with pytest.raises(CfgError, match=r"run\.toml: no such file.*walk\.toml"):
        load(file.with_name("run.toml"), Experiment)


def test_binary_file_is_refused(file):
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CfgError, match="UTF-8"):
        load(file, Experiment)


def test_overrides():
    cfg = override(
        EXPECTED, ["ppo.lr=1", "engine=warp", 'note="a=b"', "ppo.hidden=[8, 8]", "warm.clip = 0.5"]
    )
    assert cfg.ppo == Ppo(lr=1.0, hidden=(8, 8))
    assert (cfg.engine, cfg.note) == ("warp", "a=b")
    assert cfg.warm == Ppo(lr=0.5, epochs=2, clip=0.5)
    assert override(EXPECTED, []) == EXPECTED


def test_overrides_fill_in_what_a_file_leaves_out(file):
    file.write_text("[ppo]\nlr = 1.0\n")
    assert load(file, Experiment, ["seed=7"]).seed == 7


@pytest.mark.parametrize(
    ("item", "parts"),
    [
        ("ppo.lrr=1", ["unknown key ppo.lrr", "did you mean lr?"]),
        ("ppo.lr=fast", ["ppo.lr", "expected float", 'got str "fast"']),
        ("ppo.lr.x=1", ["ppo.lr", "expected float", "got table"]),
        ("ppo.lr", ["'ppo.lr'", "expected key=value"]),
        ("=1", ["expected key=value"]),
    ],
)
def test_bad_overrides(item, parts):
    with pytest.raises(CfgError) as caught:
        override(EXPECTED, [item])
    for part in ["override", item, *parts]:
        assert part in str(caught.value)


def test_dumped_text_is_toml():
    assert tomllib.loads(dump(EXPECTED))["ppo"] == {"lr": 1e-4, "epochs": 5, "hidden": [512, 256, 128]}


def test_infinity_is_a_value():
    assert override(EXPECTED, ["ppo.lr=inf"]).ppo.lr == math.inf
    assert "ppo.lr = inf\n" in dump(override(EXPECTED, ["ppo.lr=inf"]))
