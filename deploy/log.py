"""The log: what the control process hands over at once, and the process that writes it to an MCAP file.

The control process puts records into a pipe of 1 MB that never makes it wait; a record that does not fit is
counted and lost. Records end up on these topics:

================= ============================================================================================
rt/lowstate       every state frame as it came, CDR of unitree_go.msg.dds_.LowState_ (deploy.codec reads it)
rt/lowcmd         every command that differs from the one before it, CDR of unitree_go.msg.dds_.LowCmd_
tick              JSON, every control step: estimate, covariance, phase, mode, targets, lateness; see TICK
plan              JSON, every plan that came
event             JSON, phases, faults and whatever else happened
================= ============================================================================================
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from deploy.ekf import N
from deploy.process import Job, told, until_told
from deploy.settings import DeployCfg
from hmc.cfg import dump, load

VERSION = "4"
METADATA = "hmc"
STATE, COMMAND, TICK_RECORD, PLAN, EVENT = range(5)
TOPICS = ("rt/lowstate", "rt/lowcmd", "tick", "plan", "event")
PIPE = 1 << 20  # octets
CHUNK = 1 << 22  # octets, 6 s: the writer keeps an entry a chunk until the end, 1.4 KB each

# A control step; see deploy.estimate.Estimate for x and the error's order in variance.
TICK = np.dtype(
    [
        ("k", "i8"),
        ("ms", "i8"),  # the robot's clock
        ("due", "i8"),  # when the step was due by it: before that, where states were lost or came late
        ("phase", "i4"),
        ("mode", "i4"),
        ("plan", "i8"),
        ("late", "f8"),  # ms
        ("compute", "f8"),  # ms from the frame's arrival until the command left
        ("left", "f8"),  # when it did, by this machine's monotonic clock [s]
        ("x", "f8", 37),
        ("variance", "f8", N),
        ("u", "f8", 12),
        ("contact", "i4", 4),
        ("anew", "i8"),  # the robot's clock when the estimator was told to begin anew; -1: never
    ]
)
_HEAD = struct.Struct("<IBq")  # octets that follow, kind, wall clock [ns]
_LARGEST = 4096 - _HEAD.size  # a pipe takes up to 4096 octets whole or not at all


class LogError(ValueError):
    """A file that is no log of this version."""


class Recorder:
    """The control process's end of the pipe.

    Attributes:
        lost: records that did not fit.

    Args:
        descriptor: of the pipe's end to write to; -1 for no log.
    """

    def __init__(self, descriptor: int):
        self.lost = 0
        self._descriptor = descriptor
        if descriptor >= 0:
            os.set_blocking(descriptor, False)

    def add(self, kind: int, octets: bytes) -> None:
        """Hand a record over."""
        if self._descriptor < 0:
            return
        if len(octets) > _LARGEST:
            self.lost += 1
            return
        try:
            os.write(self._descriptor, _HEAD.pack(len(octets), kind, time.time_ns()) + octets)
        except (BlockingIOError, BrokenPipeError):
            self.lost += 1

    def event(self, what: str, **fields: Any) -> None:
        """Hand over that something happened; one that is too long is lost, as half of it is no JSON."""
        self.add(EVENT, json.dumps({"what": what, **fields}).encode())


def pipe() -> tuple[int, int]:
    """Descriptors of a pipe's ends, to read from and to write to, of PIPE octets where the kernel permits."""
    ends = os.pipe()
    with suppress(PermissionError):
        fcntl.fcntl(ends[1], fcntl.F_SETPIPE_SZ, PIPE)
    return ends


def write(source: BinaryIO, path: Path, about: dict[str, str]) -> None:
    """Write the records of a pipe to an MCAP file until the pipe ends.

    Args:
        source: to read from.
        path: of the file.
        about: goes into the file's metadata.
    """
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK)
        writer.start(library="hmc")
        writer.add_metadata(METADATA, {"version": VERSION, **about})
        schema = json.dumps({"type": "object"}).encode()
        channels = []
        for kind, topic in enumerate(TOPICS):
            as_json = kind not in (STATE, COMMAND)
            number = writer.register_schema(topic, "jsonschema", _schema(kind) or schema) if as_json else 0
            channels.append(writer.register_channel(topic, "json" if as_json else "cdr", number))
        counts = [0] * len(TOPICS)
        while len(head := source.read(_HEAD.size)) == _HEAD.size:
            size, kind, stamp = _HEAD.unpack(head)
            if len(octets := source.read(size)) < size or kind >= len(TOPICS):
                break
            if kind == TICK_RECORD:
                octets = json.dumps(tick_fields(np.frombuffer(octets, TICK)[0])).encode()
            writer.add_message(channels[kind], stamp, octets, stamp, counts[kind])
            counts[kind] += 1
        writer.finish()


def tick_fields(tick: Any) -> dict[str, Any]:
    """A control step as JSON takes it: numbers and lists."""
    return {name: tick[name].tolist() for name in TICK.names or ()}


def read(path: Path) -> Iterator[tuple[str, float, Any]]:
    """Topic, wall clock [s] and content of each record of a log: octets of frames, objects of JSON.

    They come as they were written, whatever was done to the clock meanwhile.

    Raises:
        LogError: not a log of this version; names what it is.
    """
    metadata(path)  # or it is no such log
    with path.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
            whole = summary.statistics.message_count if summary and summary.statistics else 0
            file.seek(0)
            # the reader that seeks has all of a log in memory, unless it goes by the clock
            reader, count = NonSeekingReader(file, validate_crcs=True), 0
            for _, channel, message in reader.iter_messages(log_time_order=False):
                is_json, count = channel.message_encoding == "json", count + 1
                yield (
                    channel.topic,
                    1e-9 * message.log_time,
                    json.loads(message.data) if is_json else message.data,
                )
            if count != whole:  # this reader passes over a chunk that looks like none
                raise ValueError(f"has {count} records, expected {whole}")
        except Exception as error:
            raise LogError(f"log {path}: damaged ({type(error).__name__} {error})") from None


def metadata(path: Path) -> dict[str, str]:
    """What a log says of its run, see `about`.

    Raises:
        LogError: not a log of this version; names what it is.
    """
    if not path.is_file():
        raise LogError(f"log {path}: no such file")
    with path.open("rb") as file:
        try:
            records = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
        except Exception as error:  # mcap and its decompressors have no type in common for damage
            raise LogError(
                f"log {path}: not a whole MCAP file ({type(error).__name__} {error}): a run that was cut "
                "short leaves one that `mcap recover` can mend"
            ) from None
    if (found := records.get(METADATA)) is None:
        raise LogError(f"log {path}: an MCAP file of another program: give a run.mcap of deploy/go2.py")
    if (version := found.get("version", "none")) != VERSION:
        raise LogError(f"log {path}: is of version {version}, expected {VERSION}: take the hmc that wrote it")
    return found


def _schema(kind: int) -> bytes:
    """JSON schema of a topic whose layout is fixed; empty for others."""
    if kind != TICK_RECORD:
        return b""
    properties: dict[str, Any] = {}
    for name in TICK.names or ():
        field = TICK[name]
        one = {"type": "integer" if field.base.kind == "i" else "number"}
        properties[name] = one
        for size in field.shape:
            properties[name] = {"type": "array", "items": one, "minItems": size, "maxItems": size}
    return json.dumps({"type": "object", "properties": properties, "required": list(properties)}).encode()


def about(job: Job) -> dict[str, str]:
    """What a log says of its run: where the robot was, and the settings as lines of `hmc.cfg.dump`."""
    settings = dump(load(job.cfg, DeployCfg, job.set))
    return {"domain": str(job.domain), "interface": job.interface, "settings": settings}


def main(job: Job) -> int:
    """Be the log's process until the control process has ended; SIGTERM is not needed and does nothing.

    Exit status 2 and one line where it cannot write on: then the control process counts what is not logged.
    """
    until_told()
    try:
        with os.fdopen(job.log, "rb") as source:
            write(source, Path(job.path), about(job))
    except OSError as error:
        print(f"log: nothing more is written: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(told()))
