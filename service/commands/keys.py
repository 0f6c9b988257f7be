"""``aicvds keys``: make, list and remove an edge's API keys."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import ValidationError
from rich.console import Console
from rich.table import Column, Table

from service.api.api_keys import BadKeys, KeyFile, Scope, editing
from shared.kit.validation_messages import problem_of


@dataclass(frozen=True)
class Add:
    """Make a key and show it once; the file has only its hash.

    Try it:  aicvds keys add fleet-1 --file keys.json --scopes decide admin --missions 'north-*'
    """

    name: Annotated[str, tyro.conf.Positional]
    """The key's name, for messages and for `remove`: letters, digits, _ . -"""
    file: Path
    """The file of keys, made if missing; AICVDS_KEYS names it to the edge, which notices changes within a second."""
    scopes: tuple[Scope, ...] = ("decide",)
    """decide: request decisions and report outcomes. admin: make, guide and delete missions. A simulator needs both.
    readings: report what sensors say of themselves, as `aicvds mqtt` does."""
    missions: tuple[str, ...] | None = None
    """The missions that the key may know of: IDs, and beginnings of IDs such as 'north-*'. For it there are no others.
    Default: all missions."""
    per_minute: int = 6000
    """Requests a minute; more are refused with 429 and Retry-After."""


@dataclass(frozen=True)
class List:
    """Show the keys' names, scopes, limits and missions."""

    file: Path
    """The file of keys."""


@dataclass(frozen=True)
class Remove:
    """Remove a key: within a second the edge refuses it."""

    name: Annotated[str, tyro.conf.Positional]
    """The key's name."""
    file: Path
    """The file of keys."""


@dataclass(frozen=True)
class KeysOptions:
    """The API keys of an edge, once AICVDS_KEYS names their file. Exit code: 0 done, 2 usage error."""

    do: (
        Annotated[Add, tyro.conf.subcommand("add")]
        | Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[Remove, tyro.conf.subcommand("remove")]
    ) = field()


def main(argv: list[str]) -> int:
    """Run ``aicvds keys``; returns the exit code."""
    config = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)
    command = tyro.cli(KeysOptions, prog="aicvds keys", args=argv, config=config).do
    try:
        match command:
            case Add():
                with editing(command.file) as known:
                    shown = known.add(command.name, frozenset(command.scopes), command.per_minute, command.missions)
                print(f"Key {command.name}, shown this once; send it as `Authorization: Bearer KEY`:", file=sys.stderr)
                print(shown)
            case List():
                table = Table(*(Column(name, overflow="fold") for name in ("name", "scopes", "a minute", "missions")))
                for key in KeyFile.read(command.file).keys:
                    missions = " ".join(key.missions or ("all",))
                    table.add_row(key.name, " ".join(sorted(key.scopes)), str(key.per_minute), missions)
                Console().print(table)
            case Remove():
                with editing(command.file) as known:
                    known.remove(command.name)
                print(f"Key {command.name} is removed", file=sys.stderr)
        return 0
    except BadKeys as error:
        print(f"aicvds keys: {error}", file=sys.stderr)
    except ValidationError as error:
        fault = error.errors()[0]
        print(f"aicvds keys: {fault['loc'][0]}: {problem_of(fault)}", file=sys.stderr)
    return 2
