"""Made packets of Velodyne sensors."""

import struct


def vlp16(first, stamp, distance=5000, model=0x22):
    """A packet of a VLP-16: 12 blocks of 0.4 degrees each, distances in units of 2 mm."""
    blocks = b"".join(
        struct.pack("<HH", 0xEEFF, (first + 40 * k) % 36000) + struct.pack("<HB", distance, 7) * 32 for k in range(12)
    )
    return blocks + struct.pack("<IBB", stamp, 0x37, model)
