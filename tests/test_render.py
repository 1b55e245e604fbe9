"""Pictures of a run: what cannot be shown is said before any OpenGL is tried, and what comes out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hmc.go2.stances import FOOTSTAND
from tools import render
from tools.render import Args, main, strip_steps


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "seed_0.json"
    x = FOOTSTAND.state().tolist()
    path.write_text(json.dumps({"steps": [{"x": x, "mode": "foot"}] * 4}))
    return path


@pytest.mark.parametrize(
    ("text", "given", "line"),
    [
        (None, {}, "No such file"),
        ("{}", {}, "expected the log of a run"),
        ("not a log", {}, "expected the log of a run"),
        ('{"steps": []}', {}, "expected the log of a run"),
        ("", {"frames": 0}, "frames must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_shown(log, monkeypatch, capsys, text: str | None, given: dict[str, Any], line: str):
    monkeypatch.setattr(render, "render_run", lambda _: pytest.fail("tried"))
    if text is None:
        log.unlink()
    elif text:
        log.write_text(text)
    with pytest.raises(SystemExit) as ended:
        main(Args(log, **given))
    assert ended.value.code == 2
    assert line in capsys.readouterr().err


def test_nothing_rendered_is_not_a_success(log, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "no_such_backend")
    assert main(Args(log)) == 1
    assert "no video: OpenGL is missing here" in capsys.readouterr().out


def test_a_strip_of_one():
    assert strip_steps(["hand"] * 10, 1) == [0]
    assert len(strip_steps(["foot"] * 10 + ["jump"] * 10, 1)) == 1


def test_larger_than_the_models_own_pictures(log, capsys):
    if main(Args(log, frames=1)) != 0:  # of the usual size
        pytest.skip(capsys.readouterr().out.strip())
    log.with_suffix(".png").unlink()
    assert main(Args(log, frames=1, width=1440, height=810)) == 0
    assert log.with_suffix(".png").stat().st_size > 0
