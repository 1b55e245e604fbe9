"""Video and time-lapse of a recorded run: `python tools/render.py out/flip/seed_0.json`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import tyro  # noqa: E402

from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools.study import at_least_one  # noqa: E402

BACKENDS = ("egl", "osmesa", "glfw")
EVERY = 2  # control steps a picture: without a GPU a picture takes a core 0.1 s


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        log: seed_*.json of tools/flip.py, or play.json of train/ppo.py --play.
        frames: of the strip.
        width: of the video [pixels].
        height: of the video [pixels].
        samples: a pixel, against jagged edges; without a GPU, 4 take twice the time of none.
        backend: of OpenGL, see MUJOCO_GL; default: the first that works.
    """

    log: tyro.conf.Positional[Path]
    frames: int = 9
    width: int = 640
    height: int = 480
    samples: int = 0
    backend: str = ""


def render_run(args: Args) -> str:
    """Render in a process of its own, with the first OpenGL backend that works; "" or why it did not."""
    command = [sys.executable, __file__, str(args.log), "--frames", str(args.frames)]
    command += ["--width", str(args.width), "--height", str(args.height), "--samples", str(args.samples)]
    reason = ""
    for backend in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else BACKENDS:
        done = subprocess.run([*command, "--backend", backend], capture_output=True, text=True)
        if done.returncode == 0:
            return ""
        reason = (done.stderr.strip().splitlines() or ["unknown error"])[-1]
    return f"no video: OpenGL is missing here ({reason}); everything else is written"


def main(args: Args) -> int:
    """Render one run: a video and a strip of frames beside its log; return the exit status."""
    if args.backend:
        os.environ["MUJOCO_GL"] = args.backend  # read when mujoco is imported
        draw(args)
        return 0
    with one_line_errors():
        at_least_one(args, "frames", "width", "height")
        read(args.log)
    failed = render_run(args)
    print(failed or f"{args.log.with_suffix('.mp4')} and {args.log.with_suffix('.png')}")
    return 1 if failed else 0


def read(log: Path) -> list[dict[str, Any]]:
    """The records of a run, of each step that is shown.

    Raises:
        ValueError: it is no run's log.
        OSError: it cannot be read.
    """
    try:
        steps: list[dict[str, Any]] = json.loads(log.read_text(encoding="utf-8"))["steps"][::EVERY]
        if all(len(step["x"]) == 37 and step["mode"] for step in steps) and steps:
            return steps
    except (ValueError, LookupError, TypeError):
        pass
    raise ValueError(f"{log}: expected the log of a run, seed_*.json of tools/flip.py or a play.json")


def draw(args: Args) -> None:
    """Render with the OpenGL backend that is set."""
    import imageio.v2 as imageio
    import numpy as np

    steps = read(args.log)
    states = np.array([step["x"] for step in steps])
    video = args.log.with_suffix(".mp4")
    partial = video.with_suffix(".partial.mp4")
    chosen = strip_steps([step["mode"] for step in steps], args.frames)
    kept = []
    writer: Any
    with imageio.get_writer(partial, fps=50 // EVERY, macro_block_size=16, quality=7) as writer:
        for step, image in enumerate(images(states, args.width, args.height, args.samples)):
            writer.append_data(image)
            if step in chosen:
                kept.append(image)
    os.replace(partial, video)
    middle = slice(args.width // 2 - args.width // 4, args.width // 2 + args.width // 4)
    imageio.imwrite(args.log.with_suffix(".png"), np.hstack([image[:, middle] for image in kept]))


def strip_steps(modes: list[str], frames: int) -> list[int]:
    """Pictures to show: evenly over the run, or if it begins in the foot stand, over the flip."""
    shares = [i / max(1, frames - 1) for i in range(frames)]
    if modes[0] != "foot" or len(set(modes)) == 1:
        return sorted({round((len(modes) - 1) * share) for share in shares})
    jump = next(step for step, mode in enumerate(modes) if mode != "foot")
    first = max(jump - 6 // EVERY, 0)
    last = min(first + 64 // EVERY, len(modes) - 1)
    return sorted({round(first + (last - first) * share) for share in shares})


def images(states: NDArray[Any], width: int, height: int, samples: int) -> Iterator[NDArray[Any]]:
    """Pictures (height, width, 3) uint8 of states (n, 37), the camera following the robot."""
    import mujoco

    from hmc.go2.model import load_model

    model = load_model()
    model.vis.quality.offsamples = samples
    room = model.vis.global_  # of the pictures that can be drawn
    room.offwidth, room.offheight = max(room.offwidth, width), max(room.offheight, height)
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 2.0, 90.0, -8.0
    with mujoco.Renderer(model, height, width) as renderer:
        follow = states[0, 0]
        for x in states:
            data.qpos[:] = x[:19]
            mujoco.mj_forward(model, data)
            follow += 0.1 * (x[0] - follow)
            camera.lookat[:] = [follow, x[1], 0.4]
            renderer.update_scene(data, camera)
            yield renderer.render()


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
