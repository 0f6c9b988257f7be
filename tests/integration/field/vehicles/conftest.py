"""The missions and the port of vehicles that speak MAVLink over UDP."""

from __future__ import annotations

import socket

import pytest

from simulator.sites.plans.plan_folder import export_plans
from tests.support.airframe import Item
from tests.support.vehicle_worlds import mission_in
from tests.support.world_folders import EXAMPLE


@pytest.fixture(scope="module")
def missions(tmp_path_factory: pytest.TempPathFactory) -> list[list[Item]]:
    """What a ground station uploads for the example's three UAVs."""
    return [mission_in(path) for path in export_plans(EXAMPLE, tmp_path_factory.mktemp("plans"), overwrite=False)]


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        number = int(taken.getsockname()[1])
    return number
