"""The client of an edge: the UAVs' side of the HTTP interface."""

from simulator.client.edge_client import AsyncEdgeClient, EdgeClient
from simulator.client.retries_and_redirects import Exchange
from simulator.errors import EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable

__all__ = [
    "AsyncEdgeClient",
    "EdgeClient",
    "EdgeError",
    "EdgeProtocolError",
    "EdgeRefused",
    "EdgeUnreachable",
    "Exchange",
]
