"""What a test of the clock is run anew for, and what not."""

from __future__ import annotations

import pytest

from tests import conftest

pytest_plugins = ["pytester"]

FAILS = """
    import pytest

    runs = []

    @pytest.fixture
    def fresh():
        return []

    {mark}
    def test_it(fresh):
        runs.append(1)
        fresh.append(1)
        assert len(fresh) == 1
        assert len(runs) > {times}
"""


@pytest.mark.parametrize(
    ("mark", "stolen", "times", "passes"),
    [
        ("@pytest.mark.clock", 0.01, 2, True),
        ("@pytest.mark.clock", 0.01, 9, False),
        ("@pytest.mark.clock", 0.0, 1, False),
        ("@pytest.mark.clock", None, 1, False),
        ("", 0.01, 1, False),
    ],
    ids=["stolen", "stolen, and fails for good", "calm", "the kernel does not tell", "not of the clock"],
)
def test_run_anew(
    mark: str,
    stolen: float | None,
    times: int,
    passes: bool,
    pytester: pytest.Pytester,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("deploy.timing.Stolen.share", stolen)
    pytester.makeini("[pytest]\nmarkers = clock: x")
    pytester.makepyfile(FAILS.format(mark=mark, times=times))

    class Hook:
        pytest_runtest_protocol = staticmethod(conftest.pytest_runtest_protocol)

    done = pytester.inline_run(plugins=[Hook()])
    passed, _, failed = done.listoutcomes()
    assert (len(passed), len(failed)) == ((1, 0) if passes else (0, 1)), "one report, whatever came before"
