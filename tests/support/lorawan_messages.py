"""Messages as ChirpStack v4 and The Things Stack v3 send them, with the fields that their documentation shows."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from typing import Any

TENANT, APPLICATION = "52f14cd4-c6f1-4fbd-8f87-4025e1d49242", "ae5ba7f1-53a6-4f0e-9f3b-6f1f3a7c2b10"
NOW = datetime(2026, 11, 23, 12, 0, 0, tzinfo=UTC)


def dev_eui(number: int) -> str:
    return f"0004a30b001c{0x530 + number:04x}"


def rfc3339(at: datetime) -> str:
    """The time with nanoseconds, as Go and Rust write it."""
    return at.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%f") + "123Z"


def chirpstack_up(
    device: int = 0, queue: object = 17, f_cnt: int = 1, at: datetime = NOW, **changes: Any
) -> dict[str, Any]:
    return {
        "deduplicationId": f"3ac7e3c4-4401-4b8d-9386-{f_cnt:012x}",
        "time": rfc3339(at),
        "deviceInfo": {
            "tenantId": TENANT,
            "tenantName": "Pipeline",
            "applicationId": APPLICATION,
            "applicationName": "pressure",
            "deviceProfileId": "14855bf7-d10d-4aee-b618-ebfcb64dc7ad",
            "deviceProfileName": "class A",
            "deviceName": f"kp-{device}",
            "devEui": dev_eui(device),
            "deviceClassEnabled": "CLASS_A",
            "tags": {"section": "north"},
        },
        "devAddr": "00189440",
        "adr": True,
        "dr": 5,
        "fCnt": f_cnt,
        "fPort": 1,
        "confirmed": False,
        "data": "EUI=",
        "object": {"queue": queue},
        "rxInfo": [
            {"gatewayId": "0016c001f153a14c", "uplinkId": 4217106255, "rssi": -101, "snr": 4.5, "crcStatus": "CRC_OK"},
            {"gatewayId": "0016c001f153a14d", "uplinkId": 4217106256, "rssi": -96, "snr": 7.25, "crcStatus": "CRC_OK"},
        ],
        "txInfo": {
            "frequency": 868100000,
            "modulation": {"lora": {"bandwidth": 125000, "spreadingFactor": 7, "codeRate": "CR_4_5"}},
        },
        **changes,
    }


def chirpstack_status(device: int = 0, at: datetime = NOW, **changes: Any) -> dict[str, Any]:
    up = chirpstack_up(device, at=at)
    kept = {name: up[name] for name in ("time", "deviceInfo")}
    return {
        "deduplicationId": "a0e2c4d6-4401-4b8d-9386-0000000000ff",
        **kept,
        "margin": 10,
        "externalPowerSource": False,
        "batteryLevelUnavailable": False,
        "batteryLevel": 75.5,
        **changes,
    }


def the_things_stack_up(
    device: int = 0, queue: object = 17, f_cnt: int = 1, at: datetime = NOW, **changes: Any
) -> dict[str, Any]:
    numbered = {"f_cnt": f_cnt} if f_cnt else {}
    return {
        "end_device_ids": {
            "device_id": f"kp-{device}",
            "application_ids": {"application_id": "pipeline"},
            "dev_eui": dev_eui(device).upper(),
            "join_eui": "800000000000000C",
            "dev_addr": "00BCB929",
        },
        "correlation_ids": ["as:up:01HX6YGQ7E0V83YRZ7K4S5J4ZN"],
        "received_at": rfc3339(at + timedelta(milliseconds=200)),
        "uplink_message": {
            "session_key_id": "AXA50tHUfrbd21dFvVxgZg==",
            "f_port": 1,
            **numbered,
            "frm_payload": "EQ==",
            "decoded_payload": {"level": {"queue": queue}},
            "rx_metadata": [
                {"gateway_ids": {"gateway_id": "gtw1", "eui": "9C5C8E00001A05C4"}, "rssi": -35, "snr": 5.2},
                {"gateway_ids": {"gateway_id": "gtw2", "eui": "9C5C8E00001A05C5"}, "rssi": -110, "snr": -7.5},
            ],
            "settings": {"data_rate": {"lora": {"bandwidth": 125000, "spreading_factor": 7}}, "frequency": "868300000"},
            "received_at": rfc3339(at),
            "consumed_airtime": "0.056576s",
            "network_ids": {"net_id": "000013", "tenant_id": "ttn", "cluster_id": "eu1"},
            "last_battery_percentage": {"f_cnt": 14, "value": 90.0, "received_at": rfc3339(at)},
        },
        **changes,
    }


def packed(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode()
