"""`aicvds fly`: its options. tests/simulator/vehicles flies it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.support.processes import run_here
from tests.support.world_folders import EXAMPLE

GOOD = {
    "--mavlink": "udpin://127.0.0.1:14540",
    "--edge": "http://127.0.0.1:9",
    "--mission": "m",
    "--world": str(EXAMPLE),
}


def refused(out: Path, **changes: str | None) -> str:
    """The one line of a command that ends before it connects."""
    options = GOOD | {"--out": str(out)} | {f"--{name.replace('_', '-')}": value for name, value in changes.items()}
    flown = run_here("fly", *(part for name, value in options.items() if value is not None for part in (name, value)))
    assert flown.returncode == 2 and flown.stderr.count("\n") == 1, flown.stderr
    return flown.stderr


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("mavlink", None, "--mavlink is missing: give each UAV's connection"),
        ("edge", None, "--edge is missing"),
        ("mission", None, "--mission is missing: give the mission's ID"),
        ("mission", "a b", "--mission 'a b': use letters"),
        ("world", None, "--world is missing: give the folder"),
        ("world", "/nowhere", "--world /nowhere is no folder"),
        ("uav", "3", "--uav 3: the world has 3 trajectories and --mavlink names 1; choose 0 to 2"),
        ("speedup", "0", "--speedup 0 is not between 0.1 and 100.0"),
        ("patience_s", "11", "--patience-s 11 is not between 0.05 and 10.0"),
        ("deadline_ms", "5", "--deadline-ms 5 is not between 10 and 60000"),
        ("radio", "gateway", "--radio gateway: write simulated, or MODULE:NAME of your own"),
        ("mavlink", "nonsense", "--mavlink nonsense: "),
        ("system_id", "256", "--system-id 256 is not between 1 and 255"),
    ],
)
def test_an_option_that_cannot_be_used_is_named(tmp_path: Path, option: str, value: str | None, says: str) -> None:
    assert says in refused(tmp_path, **{option: value})


@pytest.mark.parametrize("second", ["udpin://0.0.0.0:14540", "udp://:14540", "udpin://127.0.0.1:14540"])
def test_two_connections_that_hear_the_same_vehicle_are_refused(tmp_path: Path, second: str) -> None:
    options = [part for name, value in (GOOD | {"--out": str(tmp_path)}).items() for part in (name, value)]
    options.insert(2, second)
    flown = run_here("fly", *options)
    assert flown.returncode == 2 and "two connections to one place (UDP port 14540) would hear the same" in flown.stderr


def test_an_earlier_log_stays(tmp_path: Path) -> None:
    (tmp_path / "decisions.jsonl").write_text("", encoding="utf-8")
    assert "choose another folder or add --overwrite" in refused(tmp_path)


def test_without_the_extra_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name == "mavsdk" or name.startswith("mavsdk.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("shared.kit.command_line.find_spec", lambda module: None)

    class Missing:
        def find_spec(self, name: str, *_: object) -> None:
            if name.partition(".")[0] == "mavsdk":
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(sys, "meta_path", [Missing(), *sys.meta_path])
    assert "mavsdk is not installed. Install the extra: pip install 'aic-vds[mavlink]'" in refused(tmp_path)
