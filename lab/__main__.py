"""``python -m lab``: see :mod:`lab.command_line`."""

from __future__ import annotations

import sys

from lab.command_line import main

sys.exit(main())
