"""Code of the user's own, named as ``MODULE:NAME`` or ``FILE.py:NAME`` in an option."""

import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any


def imported(name: str) -> Any:
    """What ``MODULE:NAME`` names, looked for in the working directory and PYTHONPATH, or ``FILE.py:NAME``.

    Raises:
        ValueError: there is no such module, file or name, or the text has another form.
    """
    module, _, attribute = name.rpartition(":")
    if not module or not attribute:
        raise ValueError("write MODULE:NAME, such as my_module:MyClass, or FILE.py:NAME")
    if module.endswith(".py"):
        found: Any = getattr(_from_file(Path(module)), attribute, None)
        if found is None:
            raise ValueError(f"{module} has no {attribute}")
        return found
    # A console script does not have the working directory on its path.
    sys.path.insert(0, "")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{error}; it is looked for in the working directory and PYTHONPATH") from None
    finally:
        sys.path.remove("")


def _from_file(path: Path) -> ModuleType:
    """The module of a file, run once a process, whose folder its own imports find first."""
    # A name that shadows no module: a user's file may be called random.py.
    name = f"own_code:{path.resolve()}"
    if name in sys.modules:
        return sys.modules[name]
    spec = spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"there is no file {path}")
    module = module_from_spec(spec)
    sys.path.insert(0, str(path.parent.resolve()))
    # Dataclasses look their module up by its name while it runs.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (ImportError, SyntaxError) as error:
        del sys.modules[name]
        raise ValueError(f"{path}: {error}") from None
    finally:
        sys.path.remove(str(path.parent.resolve()))
    return module
