"""Made packets of Ouster sensors, and the points in them.

The encoder follows the published formats bit by bit and shares no code with the decoder.
"""

import struct
from math import cos, hypot, pi, radians, sin

import numpy as np

# profile -> bytes of a pixel, bits and unit of the range
PROFILES = {
    "LEGACY": (12, 20, 1),
    "RNG19_RFL8_SIG16_NIR16": (12, 19, 1),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (16, 19, 1),
    "RNG15_RFL8_NIR8": (4, 15, 8),
    "RNG15_RFL8_NIR8_DUAL": (8, 15, 8),
    "FUSA_RNG15_RFL8_NIR8_DUAL": (8, 15, 8),
}
ALTITUDE, AZIMUTH = [20.0, 5.5, -3.0, -17.25], [3.1, -1.2, 4.0, 0.0]
COLUMNS, PER_PACKET, BEAMS = 32, 8, 4
TO_SENSOR = [0, 1, 0, 10, -1, 0, 0, 20, 0, 0, 1, 30, 0, 0, 0, 1]


def metadata(profile="RNG19_RFL8_SIG16_NIR16", **changes):
    return {
        "beam_altitude_angles": ALTITUDE,
        "beam_azimuth_angles": AZIMUTH,
        "lidar_origin_to_beam_origin_mm": 15.806,
        "lidar_to_sensor_transform": TO_SENSOR,
        "prod_sn": "123456789",
        "udp_port_lidar": 7502,
        "data_format": {
            "columns_per_frame": COLUMNS,
            "columns_per_packet": PER_PACKET,
            "pixels_per_column": BEAMS,
            "column_window": [0, COLUMNS - 1],
            "udp_profile_lidar": profile,
        },
        **changes,
    }


def ranges_of(frame, profile="RNG19_RFL8_SIG16_NIR16"):
    """(columns, beams) mm, a fifth of them without a return."""
    random = np.random.default_rng(frame)
    unit = PROFILES[profile][2]
    most = 2 ** PROFILES[profile][1] * unit
    ranges = random.integers(1, most // unit, (COLUMNS, BEAMS)) * unit
    return np.where(random.random(ranges.shape) < 0.2, 0, ranges)


def packet(frame_id, first, ranges, profile="RNG19_RFL8_SIG16_NIR16", time=10**12, serial=123456789, invalid=()):
    """The packet of `PER_PACKET` columns from `first` on."""
    size, bits, unit = PROFILES[profile]
    body = b""
    for column in range(first, first + PER_PACKET):
        stamp = struct.pack("<QH", time + column * 1000, column)
        pixels = b""
        for value in ranges[column]:
            word = (int(value) // unit) | (0xA5A5A5A5 << bits & 0xFFFFFFFF)
            pixels += struct.pack("<I", word)[: 2 if bits == 15 else 4].ljust(size, b"\x5a")
        if profile == "LEGACY":
            status = 0 if column in invalid else 0xFFFFFFFF
            body += stamp + struct.pack("<HI", frame_id, 77) + pixels + struct.pack("<I", status)
        else:
            body += stamp + struct.pack("<H", column not in invalid) + pixels
    if profile == "LEGACY":
        return body
    if profile.startswith("FUSA"):
        head = struct.pack("<B3sI3s5s", 1, b"\x01\x02\x03", frame_id, b"", serial.to_bytes(5, "little"))
    else:
        head = struct.pack("<HH3s5s", 1, frame_id, b"\x01\x02\x03", serial.to_bytes(5, "little"))
    return head.ljust(32, b"\0") + body + bytes(32)


def packets_of(frame_ids, profile="RNG19_RFL8_SIG16_NIR16", **options):
    return [
        packet(
            frame_id % 65536, first, ranges_of(frame_id, profile), profile, time=10**12 + frame_id * 10**8, **options
        )
        for frame_id in frame_ids
        for first in range(0, COLUMNS, PER_PACKET)
    ]


def expected_points(ranges, along=15.806, up=0.0):
    """Sorted points m in the sensor's frame, computed one by one with the manual's formulas."""
    points = []
    for column in range(COLUMNS):
        for beam in range(BEAMS):
            value = ranges[column][beam]
            if value:
                turn = 2 * pi * (1 - column / COLUMNS)
                azimuth, altitude = -radians(AZIMUTH[beam]), radians(ALTITUDE[beam])
                reach = value - hypot(along, up)
                x = reach * cos(turn + azimuth) * cos(altitude) + along * cos(turn)
                y = reach * sin(turn + azimuth) * cos(altitude) + along * sin(turn)
                z = reach * sin(altitude) + up
                points.append([(y + 10) / 1000, (-x + 20) / 1000, (z + 30) / 1000, beam])
    return np.array(sorted(points))


def decoded(frame):
    rows = np.column_stack([frame.points, frame.ring])
    return rows[np.lexsort(rows[:, ::-1].T)]
