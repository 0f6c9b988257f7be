"""The metrics of several processes of one edge as one text, each sample with the label ``process``."""

from __future__ import annotations

from collections.abc import Mapping


def gathered(texts: Mapping[str, str]) -> str:
    """Merge several processes' expositions in Prometheus's text format.

    The samples of a metric follow each other after one HELP and one TYPE, as the format demands. An absent process has
    no samples: the sum of rates over the others stays right, and its counters restart with it.
    """
    heads, samples = dict[str, list[str]](), dict[str, list[str]]()
    for process, text in texts.items():
        name = ""
        for line in text.splitlines():
            if line.startswith("# HELP "):
                name = line.split(" ", 3)[2]
                heads.setdefault(name, [])
            if not line.startswith("#"):
                samples.setdefault(name, []).append(_labelled(line, process))
            elif line not in heads.setdefault(name, []) and len(heads[name]) < 2:
                heads[name].append(line)
    return "".join(f"{line}\n" for name in heads for line in (*heads[name], *samples.get(name, ())))


def _labelled(sample: str, process: str) -> str:
    """A sample with the label ``process``; no metric's name has a brace or a space."""
    name, brace, rest = sample.partition("{")
    if brace and " " not in name:
        return f'{name}{{process="{process}",{rest}'
    name, _, value = sample.partition(" ")
    return f'{name}{{process="{process}"}} {value}'
