"""The banner of `aicvds serve` after loading: page, deciding mode, store, keys, and the next command."""

from pathlib import Path

from service.config.settings import Settings
from service.storage.locks import sqlite_file
from shared.wire.schemas import LLM_MODES


def banner(settings: Settings, url: str, missions: int) -> str:
    """The lines, without the last line's end.

    Args:
        url: the edge's address.
        missions: number of missions in the store.
    """
    # A browser cannot open the address of all interfaces.
    reached = url.replace("//0.0.0.0", "//127.0.0.1").replace("//[::]", "//[::1]")
    key = "" if settings.keys is None else "AICVDS_API_KEY=… "
    rows = {
        "page": f"{reached}/",
        "decides": decides(settings),
        "store": store(settings, missions),
        "keys": "none needed" if settings.keys is None else f"as in {settings.keys}",
        "next": f"{key}aicvds simulate --edge {reached} --out runs/mission",
    }
    return "\n".join(["aicvds serve: ready", *(f"  {name:<8} {text}" for name, text in rows.items())])


def decides(settings: Settings) -> str:
    """The mode and its LLM, if it has one."""
    if settings.mode not in LLM_MODES:
        return f"mode {settings.mode}, without an LLM"
    if settings.llm_url is not None:
        return f"mode {settings.mode}, LLM {settings.llm_model or 'as listed'} at {settings.llm_url}"
    name = "SmolLM2-135M" if settings.llm_gguf is None else settings.llm_gguf.name
    if settings.embedded_adapter is not None:
        name += f" with {settings.embedded_adapter.name}"
    return f"mode {settings.mode}, embedded LLM {name}; the LLM-free policy until it is loaded (/readyz says when)"


def store(settings: Settings, missions: int) -> str:
    """Where missions are kept, without a password."""
    if settings.store == "none":
        return "none: missions end with this process"
    file = sqlite_file(settings.store)
    where = "PostgreSQL" if file is None else str(Path(file).absolute())
    return f"{where}, {missions} mission{'' if missions == 1 else 's'}"
