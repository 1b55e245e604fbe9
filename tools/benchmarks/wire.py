"""What a message to or from the robot costs, and how long a round trip between two processes takes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.benchmarks.figures import Common, Figures

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Wire(Common):
    """Codec, checksum and transport; needs the deploy extra.

    Attributes:
        repeats: of each message on its own, five times; the fastest of the five counts.
        messages: that go to another process and come back, at 500 Hz.
        domain: of DDS, on the loopback interface; 0 for one by the process's number.
    """

    repeats: int = 2000
    messages: int = 3000
    domain: int = 0


def wire(args: Wire) -> Figures:
    """Measure."""
    # in here, so that the other benchmarks run without the extra
    from deploy.codec import decode_command, decode_state, encode_command, encode_state
    from deploy.crc import crc32
    from tools.robot.motors import damp
    from tools.robot.standin import Settings, StandIn

    figures = Figures()
    robot = StandIn(Settings())
    (state_frame,) = robot.step([])
    command, state = damp(3.0), decode_state(state_frame)
    command_frame = encode_command(command)
    work: dict[str, tuple[Callable[[], object], str]] = {
        "crc_us": (lambda: crc32(state_frame[4:]), "checksum of a LowState frame [us]"),
        "command_encode_us": (lambda: encode_command(command), "arrays to LowCmd frame [us]"),
        "command_decode_us": (lambda: decode_command(command_frame), "LowCmd frame to arrays [us]"),
        "state_encode_us": (lambda: encode_state(state), "arrays to LowState frame [us]"),
        "state_decode_us": (lambda: decode_state(state_frame), "LowState frame to arrays [us]"),
    }
    for name, (once, note) in work.items():
        figures.add(name, 1e6 * fastest(once, args.repeats), note)
    share = fastest(lambda: robot.step([]), max(1, args.repeats // 20)) / 0.002
    figures.add("robot_share", share, "of the stand-in's 2 ms that it computes, one core")
    times, lost = round_trips(args, command_frame)
    for name, part in (("p50", 0.5), ("p99", 0.99), ("max", 1.0)):
        note = "LowCmd there and LowState back, decoded and encoded [ms]"
        figures.add(f"round_trip_ms_{name}", 1e3 * float(np.quantile(times, part)), note)
    figures.add("answered", 1 - lost, "of the messages")
    return figures


def fastest(once: Callable[[], object], repeats: int) -> float:
    """Seconds of one call: the mean of a batch, of five batches the fastest."""
    batches = []
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(repeats):
            once()
        batches.append((time.perf_counter() - start) / repeats)
    return min(batches)


def round_trips(args: Wire, frame: bytes) -> tuple[list[float], float]:
    """Times from command to answer [s], and the share without one within 2 ms of the next."""
    from deploy.codec import decode_state
    from deploy.dds import Link
    from deploy.messages import LowCmd_, LowState_

    domain = args.domain or 20 + os.getpid() % 200
    code = f"from tools.benchmarks.wire import echo; echo({domain})"
    times = []
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT) as peer:
        link = Link(domain)
        states, commands = link.subscriber("rt/lowstate", LowState_), link.publisher("rt/lowcmd", LowCmd_)
        while not (states.peers and commands.peers):
            time.sleep(0.01)
        time.sleep(0.2)  # for the peer to find us, too
        due = time.perf_counter()
        for _ in range(args.messages):
            states.take()  # an answer that came too late
            sent = time.perf_counter()
            commands.write(frame)
            if answer := states.take(0.05):
                decode_state(answer[-1])
                times.append(time.perf_counter() - sent)
            due = max(due + 0.002, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
        peer.terminate()
    return times, 1 - len(times) / args.messages


def echo(domain: int) -> None:
    """Answer every command with a state, until terminated."""
    from deploy.codec import decode_command, decode_state, encode_state
    from deploy.dds import Link
    from deploy.messages import LowCmd_, LowState_
    from tools.robot.standin import StandIn, ideal

    link = Link(domain)
    commands, states = link.subscriber("rt/lowcmd", LowCmd_), link.publisher("rt/lowstate", LowState_)
    state = decode_state(StandIn(ideal()).step([])[0])
    while True:
        for frame in commands.take(1.0):
            motors = decode_command(frame).motors
            states.write(encode_state(state._replace(q=motors.q)))
