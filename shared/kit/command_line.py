"""The ``aicvds`` command: finds its subcommands by entry point and imports only the one that it runs."""

import os
import select
import signal
import sys
import tomllib
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from pathlib import Path

from shared.kit.validation_messages import suggestion

_TEXTS = tomllib.loads(Path(__file__).with_name("commands.toml").read_text(encoding="utf-8"))
_SUMMARIES: dict[str, str] = _TEXTS["summaries"]
_EXTRAS: dict[str, str] = _TEXTS["extras"]
# By module of an extra, the extra where only some options of the simulator's commands import it.
_EXTRA_OF_MODULE: dict[str, str] = _TEXTS["modules"]
# For an editable installation, which has today's code, but the commands of the day when it was made.
_STALE: str = _TEXTS["stale"]


def usage() -> str:
    """The text of ``aicvds --help``."""
    return str(_TEXTS["usage"]).format(commands="\n".join(f"  {name:<14} {text}" for name, text in _SUMMARIES.items()))


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
        if module not in _EXTRA_OF_MODULE or find_spec(module) is not None:
            raise
        extra = _EXTRAS.get(name, "service")
        if not found[0].value.startswith("service"):
            extra = _EXTRA_OF_MODULE[module] or _EXTRAS.get(name, "simulator")
        print(
            f"aicvds {name}: {missing.name} is not installed. Install the extra: pip install 'aic-vds[{extra}]'",
            file=sys.stderr,
        )
        return 2


if __name__ == "__main__":
    sys.exit(main())
