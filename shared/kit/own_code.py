"""Code of the user's own, named as ``MODULE:NAME`` in an option."""

import sys
from importlib import import_module
from typing import Any


def imported(name: str) -> Any:
    """What ``MODULE:NAME`` names, looked for in the working directory and PYTHONPATH.

    Raises:
        ValueError: there is no such module or name, or the text has another form.
    """
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError("write MODULE:NAME, such as my_module:MyClass")
    # A console script does not have the working directory on its path.
    sys.path.insert(0, "")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{error}; it is looked for in the working directory and PYTHONPATH") from None
    finally:
        sys.path.remove("")
