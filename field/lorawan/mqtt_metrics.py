"""The Prometheus metrics of ``aicvds mqtt``. No label names a device, sensor or mission."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

_AGE_BUCKETS_S = (0.5, 1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600)
_RSSI_BUCKETS_DBM = (-140, -130, -125, -120, -115, -110, -105, -100, -90, -80, -60)
_SNR_BUCKETS_DB = (-20, -17.5, -15, -12.5, -10, -7.5, -5, -2.5, 0, 2.5, 5, 10)


class MqttMetrics:
    """The metrics of one process, in their own registry."""

    def __init__(self) -> None:
        self.registry = r = CollectorRegistry()
        self.uplinks = Counter(
            "aicvds_mqtt_uplinks", "Messages of the broker by what became of them", ["result"], registry=r
        )
        self.readings = Counter(
            "aicvds_mqtt_readings", "Readings sent to the edge by its answer", ["result"], registry=r
        )
        self.failures = Counter("aicvds_mqtt_edge_failures", "Requests that the edge did not answer well", registry=r)
        self.connects = Counter("aicvds_mqtt_connects", "Connections to the broker by result", ["result"], registry=r)
        self.connected = Gauge("aicvds_mqtt_connected", "Whether the broker is subscribed to, 1 or 0", registry=r)
        self.waiting = Gauge("aicvds_mqtt_waiting", "Readings that wait for the edge, at most one a device", registry=r)
        self.age_s = Histogram(
            "aicvds_mqtt_age_seconds", "Age of a reading as it is sent to the edge", registry=r, buckets=_AGE_BUCKETS_S
        )
        self.rssi_dbm = Histogram(
            "aicvds_mqtt_rssi_dbm",
            "Signal strength at the gateway that heard an uplink best",
            registry=r,
            buckets=_RSSI_BUCKETS_DBM,
        )
        self.snr_db = Histogram(
            "aicvds_mqtt_snr_db",
            "Signal-to-noise ratio at the gateway that heard an uplink best",
            registry=r,
            buckets=_SNR_BUCKETS_DB,
        )
