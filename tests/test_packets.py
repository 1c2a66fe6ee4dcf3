"""Captures of synthetic packets: all profiles of Ouster, all capture formats, lost packets."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hostile_files import with_changed_bytes
from ouster_packets import (
    COLUMNS,
    PER_PACKET,
    PROFILES,
    decoded,
    expected_points,
    metadata,
    packet,
    packets_of,
    ranges_of,
)
from velodyne_packets import vlp16

from lidarpose.errors import InputError
from lidarpose.io.sources import DamagedFrame, open_source, pcap
from lidarpose.io.sources.ouster import OusterFormat, OusterRecording
from lidarpose.io.sources.pcap import Capture, Datagram

RECORDINGS = sorted((Path(__file__).parents[2] / "shared" / "data" / "ouster").glob("*.pcap"))


# ---- captures


def ip4(payload, port=7502, source=b"\x0a\0\0\x01", mtu=None, number=9):
    """IPv4 packets of a UDP datagram, in fragments if it is longer than `mtu`."""
    data = struct.pack(">HHHH", 7502, port, 8 + len(payload), 0) + payload
    step = len(data) if mtu is None else mtu // 8 * 8
    parts = []
    for offset in range(0, len(data), step):
        part = data[offset : offset + step]
        flags = (offset + step < len(data)) << 13 | offset // 8
        head = struct.pack(">BBHHHBBH", 0x46, 0, 24 + len(part), number, flags, 64, 17, 0)
        parts.append(head + source + b"\x0a\0\0\x02" + b"\x01\x01\x01\0" + part)
    return parts


def ip6(payload, port=7502, mtu=None):
    data = struct.pack(">HHHH", 7502, port, 8 + len(payload), 0) + payload
    addresses = bytes(15) + b"\x01" + bytes(15) + b"\x02"
    if mtu is None:
        return [struct.pack(">IHBB", 6 << 28, len(data), 17, 64) + addresses + data]
    parts = []
    for offset in range(0, len(data), mtu // 8 * 8):
        part = data[offset : offset + mtu // 8 * 8]
        fragment = struct.pack(">BBHI", 17, 0, offset | (offset + len(part) < len(data)), 5)
        parts.append(struct.pack(">IHBB", 6 << 28, 8 + len(part), 44, 64) + addresses + fragment + part)
    return parts


MACS = bytes(12)
LINKS = {
    "ethernet": (1, lambda ip: MACS + (b"\x08\0" if ip[:1] < b"\x60" else b"\x86\xdd") + ip.ljust(46, b"\0")),
    "vlan": (1, lambda ip: MACS + b"\x88\xa8\0\x05\x81\0\0\x07\x08\0" + ip),
    "linux": (113, lambda ip: bytes(14) + b"\x08\0" + ip),
    "linux 2": (276, lambda ip: b"\x08\0" + bytes(18) + ip),
    "linux vlan": (113, lambda ip: bytes(14) + b"\x81\0\0\x07\x08\0" + ip),
    "linux 2 vlan": (276, lambda ip: b"\x81\0" + bytes(18) + b"\0\x07\x08\0" + ip),
    "raw": (101, lambda ip: ip),
    "loopback": (0, lambda ip: b"\x02\0\0\0" + ip),
}


def write(path, ips, *, link="ethernet", order="<", nano=False, period=10**6):
    """A pcap file of packets, the first after 1000.0005 s, the others `period` us apart."""
    number, wrap = LINKS[link]
    data = struct.pack(order + "IHHIIII", 0xA1B23C4D if nano else 0xA1B2C3D4, 2, 4, 0, 0, 262144, number)
    for k, ip in enumerate(ips):
        frame = wrap(ip)
        time = 1_000_000_500 + k * period
        data += (
            struct.pack(order + "4I", time // 10**6, time % 10**6 * (1000 if nano else 1), *[len(frame)] * 2) + frame
        )
    path.write_bytes(data)
    return path


def write_ng(path, ips, order="<", resolution=9, frequency=10**9, offset=0):
    """pcapng with two interfaces and a block of unknown type.

    resolution: of the second interface's times, as its option states it; frequency: 1/s; offset: s, of its times.
    """

    def block(kind, body):
        body += bytes(-len(body) % 4)
        return struct.pack(order + "II", kind, len(body) + 12) + body + struct.pack(order + "I", len(body) + 12)

    data = block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    data += block(1, struct.pack(order + "HHI", 1, 0, 0)) + block(0xBAD, b"what is this")
    options = struct.pack(order + "HH4sHHB3sHHqHH", 1, 3, b"abc\0", 9, 1, resolution, b"", 14, 8, offset, 0, 0)
    data += block(1, struct.pack(order + "HHI", 101, 0, 0) + options)
    for k, ip in enumerate(ips):
        frame = LINKS["ethernet"][1](ip) if k % 2 == 0 else ip
        ticks = (1000 + k) * 10**6 if k % 2 == 0 else (1000 + k - offset) * frequency
        head = struct.pack(order + "5I", k % 2, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        data += block(6, head + frame)
    path.write_bytes(data)
    return path


def ouster(path, ips, profile="RNG19_RFL8_SIG16_NIR16", **options):
    path.with_suffix(".json").write_text(json.dumps(metadata(profile)))
    return open_source(write(path, ips, **options))


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("link", LINKS)
def test_capture_reads_all_link_types(tmp_path, link, order):
    payloads = [bytes([k]) * (10 + 700 * k) for k in range(6)]
    ips = [part for k, payload in enumerate(payloads) for part in ip4(payload, mtu=1000, number=k)]
    other = [ip4(b"tcp")[0][:9] + b"\x06" + ip4(b"tcp")[0][10:], b"", b"\x45", bytes(60)]
    path = write(tmp_path / "a.pcap", [*other, *ips], link=link, order=order, nano=link == "raw")
    datagrams = list(Capture(path))
    assert [datagram.payload for datagram in datagrams] == payloads
    assert {datagram.flow for datagram in datagrams} == {(b"\x0a\0\0\x01", 7502)}
    assert abs(datagrams[0].time - 1004.0005) < 1e-6


@pytest.mark.parametrize("order", "<>")
def test_capture_reads_pcapng_and_ipv6(tmp_path, order):
    payloads = [bytes([k]) * (10 + 700 * k) for k in range(4)]
    ips = [part for payload in payloads for part in ip6(payload, mtu=1000 if len(payload) > 1000 else None)]
    for path in (write_ng(tmp_path / "a.pcapng", ips, order), write(tmp_path / "a.pcap", ips)):
        datagrams = list(Capture(path))
        assert [datagram.payload for datagram in datagrams] == payloads and datagrams[0].time < datagrams[1].time < 1010


@pytest.mark.parametrize(
    ("resolution", "frequency", "offset"), [(9, 10**9, 0), (3, 1000, 900), (0x80 | 20, 2**20, -(10**6))]
)
def test_pcapng_time_resolution_and_offset(tmp_path, resolution, frequency, offset):
    ips = [ip4(bytes([k]))[0] for k in range(4)]
    path = write_ng(tmp_path / "a.pcapng", ips, resolution=resolution, frequency=frequency, offset=offset)
    assert [datagram.time for datagram in Capture(path)] == [1000, 1001, 1002, 1003]


def test_capture_reads_packets_with_zero_length_field(tmp_path):
    (packet,) = ip4(b"payload")
    path = write(tmp_path / "a.pcap", [packet[:2] + b"\0\0" + packet[4:]], link="raw")
    assert [datagram.payload for datagram in Capture(path)] == [b"payload"]


def test_capture_joins_fragments_and_counts_incomplete_ones(tmp_path):
    payload = bytes(range(256)) * 20
    parts = ip4(payload, mtu=1000)
    capture = Capture(write(tmp_path / "a.pcap", parts[::-1]))
    assert [datagram.payload for datagram in capture] == [payload]
    others = [part for k in range(200) for part in ip4(payload, mtu=1000, number=k + 10)[:-1]]
    capture = Capture(write(tmp_path / "b.pcap", [*others, *parts]))
    assert [datagram.payload for datagram in capture] == [payload] and capture.num_cut == 200


def test_capture_does_not_join_fragments_of_datagrams_with_repeated_number(tmp_path):
    payloads = [bytes([k]) * 2500 for k in range(3)]
    first, *others = [ip4(payload, mtu=1000) for payload in payloads]
    path = write(tmp_path / "a.pcap", [*first[:1], *first[2:], *(part for parts in others for part in parts)])
    data = bytearray(path.read_bytes())
    # the first datagram, of which a fragment is lost, is a minute older
    for start in (24, 24 + 16 + int.from_bytes(data[32:36], "little")):
        data[start : start + 4] = (940).to_bytes(4, "little")
    path.write_bytes(data)
    capture = Capture(path)
    assert [datagram.payload for datagram in capture] == payloads[1:] and capture.num_cut == 1


def test_pcapng_skips_large_blocks_without_packets(tmp_path):
    path = write_ng(tmp_path / "a.pcapng", [ip4(b"payload")[0]])
    data, name = path.read_bytes(), b"what is this"
    start = data.index(name) - 8
    large = bytes(2**20 + 100)
    block = struct.pack("<II", 4, len(large) + 12) + large + struct.pack("<I", len(large) + 12)
    path.write_bytes(data[:start] + block + data[start:])
    assert [datagram.payload for datagram in Capture(path)] == [b"payload"]
    path.write_bytes(data[:start] + block[:999])
    with pytest.raises(InputError, match="is cut off"):
        list(Capture(path))


def test_capture_joins_fragments_whose_length_is_that_of_the_first(tmp_path):
    payload = bytes(range(256)) * 20
    first, *others = ip4(payload, mtu=1000)
    # the UDP length, after an IP header of 24 bytes
    first = first[:28] + struct.pack(">H", 1000) + first[30:]
    assert [datagram.payload for datagram in Capture(write(tmp_path / "a.pcap", [first, *others]))] == [payload]


def test_pcapng_skips_packets_of_other_interfaces(tmp_path, monkeypatch):
    ips = [ip4(bytes([k]))[0] for k in range(4)]
    path = write_ng(tmp_path / "a.pcapng", ips)
    assert len(list(Capture(path))) == 4
    monkeypatch.delitem(pcap._LINKS, 101)
    assert [datagram.payload for datagram in Capture(path)] == [b"\0", b"\2"]
    monkeypatch.delitem(pcap._LINKS, 1)
    with pytest.raises(InputError, match="link type 1"):
        list(Capture(path))


# ---- Ouster


@pytest.mark.parametrize("profile", PROFILES)
def test_ouster_profiles_match_manual(tmp_path, profile):
    packets = packets_of(range(3), profile, invalid=(5,) if profile != "RNG15_RFL8_NIR8" else ())
    source = ouster(tmp_path / "a.pcap", [ip for payload in packets for ip in ip4(payload, mtu=1400)], profile)
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2] and not source.warnings
    for k, frame in enumerate(frames):
        ranges = ranges_of(k, profile)
        if profile != "RNG15_RFL8_NIR8":
            ranges[5] = 0
            assert frame.warnings == (f"1 of {COLUMNS} columns are missing",)
        assert np.allclose(decoded(frame), expected_points(ranges), rtol=0, atol=1e-9)
        assert abs(frame.time - 1000 - k / 10) < 1e-9 and np.allclose(frame.origin, [0.01, 0.02, 0.03])


def test_ouster_reads_metadata_in_sections(tmp_path):
    plain = metadata()
    form = plain.pop("data_format")
    beams = {key: plain.pop(key) for key in ("beam_altitude_angles", "beam_azimuth_angles")}
    beams["beam_to_lidar_transform"] = [1, 0, 0, 12.0, 0, 1, 0, 0, 0, 0, 1, 5.0, 0, 0, 0, 1]
    lidar = {"lidar_to_sensor_transform": plain.pop("lidar_to_sensor_transform")}
    sections = {"beam_intrinsics": beams, "lidar_intrinsics": lidar, "lidar_data_format": form, "sensor_info": plain}
    (tmp_path / "a.json").write_text(json.dumps(sections))
    (frame,) = open_source(write(tmp_path / "a.pcap", [ip4(payload)[0] for payload in packets_of([0])]))
    assert np.allclose(decoded(frame), expected_points(ranges_of(0), 12.0, 5.0), rtol=0, atol=1e-9)


def test_ouster_handles_lost_late_and_duplicate_packets(tmp_path):
    packets = packets_of([65534, 65535, 65536, 65537])
    lost = packets.pop(6)
    packets.insert(9, lost)  # of the second frame, after the third began
    packets.insert(2, packets[1])
    packets = [payload for k, payload in enumerate(packets) if k != 13]
    source = ouster(tmp_path / "a.pcap", [ip4(payload)[0] for payload in packets])
    frames = list(source)
    assert [len(frame.warnings) for frame in frames] == [0, 1, 0, 1]
    assert frames[1].warnings == (f"{PER_PACKET} of {COLUMNS} columns are missing",)
    for k in (0, 2):
        assert np.allclose(decoded(frames[k]), expected_points(ranges_of(65534 + k)), rtol=0, atol=1e-9)
    assert source.warnings == ("1 of 8 lidar packets were lost",)


def test_ouster_messages_may_have_a_spare_byte(tmp_path):
    """Drivers of 2022 and before make the buffer one byte longer than the packet."""
    packets = packets_of([1, 2])
    (tmp_path / "m.json").write_text(json.dumps(metadata()))
    frames = []
    for spare in (b"", b"\0"):
        datagrams = Messages(Datagram(k / 100, (b"t", 0), packet + spare) for k, packet in enumerate(packets))
        recording = OusterRecording(tmp_path / "a.bag", tmp_path / "m.json", datagrams=datagrams)
        frames.append([decode().points for _, decode in recording.sweeps()])
    assert len(frames[0]) == len(frames[1]) == 2
    for exact, spared in zip(*frames, strict=True):
        np.testing.assert_array_equal(exact, spared)


class Messages(list):
    num_cut = 0


def test_ouster_skips_packets_of_other_sensors(tmp_path):
    mine, other = packets_of([0, 1]), packets_of([5, 6])
    ips = [ip for a, b in zip(mine, other, strict=True) for ip in (*ip4(b, port=7512), *ip4(a), *ip4(b"imu" * 16))]
    source = ouster(tmp_path / "a.pcap", ips)
    assert np.allclose(decoded(list(source)[1]), expected_points(ranges_of(1)), rtol=0, atol=1e-9)
    assert source.warnings == ("8 lidar packets of another sensor are left out",)
    source = ouster(tmp_path / "b.pcap", [ip4(payload)[0] for payload in packets_of([0], serial=5)])
    list(source)
    assert "from the sensor 5" in source.warnings[0] and "123456789" in source.warnings[0]


def test_ouster_reads_sensor_of_metadata_of_two_on_one_port(tmp_path):
    mine, other = packets_of([0, 1]), packets_of([5, 6], serial=5)
    ips = [ip for a, b in zip(mine, other, strict=True) for ip in (*ip4(b, source=bytes([10, 0, 0, 9])), *ip4(a))]
    source = ouster(tmp_path / "a.pcap", ips)
    assert np.allclose(decoded(list(source)[1]), expected_points(ranges_of(1)), rtol=0, atol=1e-9)
    assert source.warnings == ("8 lidar packets of another sensor are left out",)


def test_ouster_column_window_expects_only_its_columns(tmp_path):
    for window, firsts in (((8, 20), (8, 16)), ((26, 9), (24, 0, 8))):
        data = metadata()
        data["data_format"]["column_window"] = window
        (tmp_path / "a.json").write_text(json.dumps(data))
        inside = [c for c in range(COLUMNS) if (window[0] <= c <= window[1]) == (window[0] < window[1]) or c in window]
        invalid = set(range(COLUMNS)) - set(inside)
        packets = [packet(k, first, ranges_of(k), invalid=invalid) for k in range(3) for first in firsts]
        source = open_source(write(tmp_path / "a.pcap", [ip4(payload)[0] for payload in packets]))
        assert [frame.warnings for frame in source] == [()] * 3 and not source.warnings


def test_open_source_accepts_path_of_metadata(tmp_path):
    path = tmp_path / "walk.pcap"
    beside = [frame.points for frame in ouster(path, [ip for payload in packets_of([0]) for ip in ip4(payload)])]
    assert open_source(path, topic="/points").warnings[0].endswith("does not have are ignored: topic")
    path.with_suffix(".json").rename(tmp_path / "sensor.json")
    for (named,) in (
        open_source(path, meta=tmp_path / "sensor.json"),
        open_source([path], meta=str(tmp_path / "sensor.json")),
    ):
        assert np.array_equal(named.points, beside[0])
    with pytest.raises(InputError, match="other.json: no such file"):
        open_source(path, meta=tmp_path / "other.json")


def test_ouster_metadata_may_have_the_recorders_number(tmp_path):
    path = tmp_path / "walk.pcap"
    (frame,) = ouster(path, [ip for payload in packets_of([0]) for ip in ip4(payload)])
    path.with_suffix(".json").rename(tmp_path / "walk_0.json")
    (numbered,) = open_source(path)
    assert np.array_equal(numbered.points, frame.points)


@pytest.mark.parametrize(
    ("product", "offset"), [("OS-0-128", 27.67), ("OS-1-64", 15.806), ("OS-2-32", 13.762), ("OS-DOME", 12.163)]
)
def test_ouster_beam_origin_depends_on_product_if_missing(tmp_path, product, offset):
    content = metadata(prod_line=product)
    del content["lidar_origin_to_beam_origin_mm"]
    (tmp_path / "a.json").write_text(json.dumps(content))
    (frame,) = open_source(write(tmp_path / "a.pcap", [ip4(payload)[0] for payload in packets_of([0])]))
    np.testing.assert_allclose(decoded(frame), expected_points(ranges_of(0), along=offset), atol=1e-9)


@pytest.mark.parametrize(("vendor", "preamble"), [("Hesai", b"\xee\xff\x01"), ("RoboSense", b"\x55\xaa\x05")])
def test_open_source_names_other_vendors(tmp_path, vendor, preamble):
    ips = [ip4(preamble + bytes(1077))[0]] * 9
    with pytest.raises(InputError, match=f"packets of a {vendor} sensor.*{vendor}'s driver"):
        open_source(write(tmp_path / "a.pcap", ips))


def test_open_source_reports_bad_captures_and_metadata(tmp_path):
    ips = [ip4(payload)[0] for payload in packets_of([0])]
    path = write(tmp_path / "walk.pcap", ips)
    with pytest.raises(InputError, match="needs its metadata walk.json beside it"):
        open_source(path)
    with pytest.raises(InputError, match="no UDP packets"):
        open_source(write(tmp_path / "empty.pcap", []))
    (tmp_path / "no.pcap").write_bytes(b"no capture")
    with pytest.raises(InputError, match="not a packet capture"):
        open_source(tmp_path / "no.pcap")
    with pytest.raises(InputError, match="link type"):
        LINKS["usb"] = (189, lambda ip: ip)
        open_source(write(tmp_path / "usb.pcap", ips, link="usb"))
    LINKS.pop("usb")

    sizes = metadata("RNG15_RFL8_NIR8")
    for content, problem in (
        ("[1]", "expected an object"),
        ("{", "cannot be read"),
        ("{}", "beam_altitude_angles"),
        (json.dumps(sizes), "expected lidar packets of .* got 4 of"),
        (json.dumps(metadata("RNG99")), "udp_profile_lidar.*RNG99"),
        (json.dumps(metadata(beam_azimuth_angles=[1.0])), "4 altitudes and 1 azimuths"),
        (json.dumps(metadata(beam_altitude_angles=[1.0, float("nan"), 1, 1])), "finite"),
        (json.dumps(metadata(lidar_to_sensor_transform=[1, 2])), "cannot be read"),
        (json.dumps(metadata(data_format={"columns_per_frame": 10**9})), "columns_per_frame from 1 to"),
        (json.dumps(metadata(data_format={"columns_per_frame": None})), "cannot be read"),
        (json.dumps(metadata(data_format={"columns_per_frame": COLUMNS, "column_window": [1]})), "cannot be read"),
        (json.dumps(metadata(lidar_to_sensor_transform=[1e308] * 16)), "finite numbers in lidar_to_sensor"),
        ("[" * 10**5, "cannot be read"),
    ):
        (tmp_path / "walk.json").write_text(content)
        with pytest.raises(InputError, match=problem) as error:
            open_source(path)
        assert "\n" not in str(error.value)


def test_ouster_keeps_whole_frames_of_damaged_capture(tmp_path):
    source = ouster(tmp_path / "a.pcap", [ip for k in packets_of(range(6)) for ip in ip4(k, mtu=200)])
    path, data = tmp_path / "a.pcap", (tmp_path / "a.pcap").read_bytes()
    assert len(list(source)) == 6
    path.write_bytes(data[: len(data) * 7 // 12])
    *frames, end = source
    assert len(frames) == 4 and isinstance(end, DamagedFrame) and "cut off" in end.error
    for k, frame in enumerate(frames[:3]):
        assert np.allclose(decoded(frame), expected_points(ranges_of(k)), rtol=0, atol=1e-9)
    random = np.random.default_rng(7)
    for broken in with_changed_bytes(data, random, 40):
        path.write_bytes(broken)
        try:
            assert all(
                isinstance(frame, DamagedFrame) or np.isfinite(frame.points).all() for frame in open_source(path)
            )
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.skipif(not RECORDINGS, reason="no Ouster recordings on this machine")
@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_ouster_recordings_have_complete_frames(path):
    (frame,) = open_source(path)
    assert len(frame.points) > 20_000 and not frame.warnings
    assert frame.ring.max() + 1 == OusterFormat(path.with_suffix(".json")).beams


# ---- Velodyne


def test_velodyne_packets_become_frames(tmp_path):
    pytest.importorskip("velodyne_decoder", reason="the extra recordings is not installed")
    ips = [ip4(vlp16(k * 480 % 36000, k * 1330))[0] for k in range(200)]
    source = open_source(write(tmp_path / "a.pcap", [*ips, *ip4(bytes(512), port=8308)], period=1330))
    first, second, _ = frames = list(source)
    assert len(frames) == 3 and not source.warnings and 1000 < first.time < 1000.15 < second.time < 1000.25
    assert np.allclose(np.linalg.norm(second.points, axis=1), 10, atol=0.1)
    assert sorted(np.unique(second.ring)) == list(range(16)) and np.array_equal(second.origin, np.zeros(3))
    elevation = [np.degrees(np.arcsin(second.points[second.ring == k, 2] / 10)).mean() for k in range(16)]
    assert np.allclose(sorted(elevation), np.arange(-15, 16, 2), atol=0.1)
    assert [frame.index for frame in source.frames(2)] == [2]

    broken = [*ip4(bytes(1206)), *ips[:5]]
    source = open_source(write(tmp_path / "b.pcap", broken, period=1330))
    assert len(list(source)) == 1 and source.warnings == ("1 packets are not from the sensor's model and are left out",)
    hdl64 = [ip4(vlp16(0, k, model=k * 11))[0] for k in range(9)]
    with pytest.raises(InputError, match="HDL-64E, but has no calibration in it"):
        open_source(write(tmp_path / "d.pcap", hdl64))
    with pytest.raises(InputError, match="Velodyne model that can be decoded"):
        open_source(write(tmp_path / "c.pcap", [ip4(bytes(1206))[0]] * 9))


def hdl64e_packets(year=16):
    """Packets of an HDL-64E S2, whose last bytes are its state and its calibration, one byte each."""
    lasers = b"".join(struct.pack("<B9hBB", k, 10 * k - 500, *(0,) * 8, 10, 255) + bytes(7) for k in range(64))
    date = bytes([year, 1, 2, 3, 4, 5]) if year else b"\xff" * 6
    content = b"UNIT#" + bytes(2) + lasers[:-7] + date + bytes(20) + struct.pack("<H", 1820)
    assert len(content) == 1820
    states = [*((ord(letter), 1) for letter in "HMSDNYGTV"), *((0x30 + k % 7, byte) for k, byte in enumerate(content))]
    return [vlp16(k * 480 % 36000, k, model=byte)[:-2] + bytes([kind, byte]) for k, (kind, byte) in enumerate(states)]


def test_velodyne_hdl64e_calibration_is_read_from_any_capture(tmp_path):
    pytest.importorskip("velodyne_decoder", reason="the extra recordings is not installed")
    ips = [ip4(payload)[0] for payload in hdl64e_packets()]
    counts = [
        len(list(open_source(path))) for path in (write(tmp_path / "a.pcap", ips), write_ng(tmp_path / "a.pcapng", ips))
    ]
    assert counts[0] == counts[1] > 20
    with pytest.raises(InputError, match="calibration not set in the sensor"):
        list(open_source(write(tmp_path / "b.pcap", [ip4(payload)[0] for payload in hdl64e_packets(year=0)])))


def test_velodyne_capture_beside_another_json_is_read(tmp_path):
    pytest.importorskip("velodyne_decoder", reason="the extra recordings is not installed")
    path = write(tmp_path / "a.pcap", [ip4(vlp16(k * 480 % 36000, k * 1330))[0] for k in range(80)], period=1330)
    path.with_suffix(".json").write_text("[]")
    assert len(list(open_source(path))) == 2


def livox(points, stamp=0, first_protocol=False):
    """A packet of a Livox sensor: points (96, 3) m in mm, with reflectivity and tag."""
    data = b"".join(struct.pack("<3iBB", *row, 9, 0) for row in np.rint(1e3 * points).astype(int).tolist())
    if first_protocol:
        return struct.pack("<4BI2BQ", 5, 1, 1, 0, 0, 0, 2, stamp) + data
    return struct.pack("<BHHHHBBB12xIQ", 0, 36 + len(data), 100, len(points), 0, 0, 1, 0, 0, stamp) + data


@pytest.mark.parametrize("first_protocol", [False, True])
def test_livox_packets_become_frames(tmp_path, first_protocol):
    rng = np.random.default_rng(0)
    clouds = np.round(rng.uniform(-30, 30, (30, 96, 3)), 3)
    clouds[3, 5] = 0
    packets = [ip4(livox(points, first_protocol=first_protocol))[0] for points in clouds]
    # packets of the same size that are not of points, one of a Velodyne's size, and measurements of motion
    others = [*ip4(bytes(len(livox(clouds[0], first_protocol=first_protocol))), port=443), *ip4(bytes(1206), port=443)]
    others += ip4(bytes(60))
    ips = [*others[:2], *packets[:5], *others, *packets[5:]]
    source = open_source(write(tmp_path / "a.pcap", ips, period=10_000))
    frames = list(source)
    assert [frame.time for frame in frames] == pytest.approx([1000.0205, 1000.1205, 1000.2205, 1000.3205])
    points = np.concatenate([frame.points for frame in frames])
    np.testing.assert_allclose(points, clouds.reshape(-1, 3)[clouds.reshape(-1, 3).any(1)], atol=1e-9)
    assert source.warnings == ("2 lidar packets of another sensor are left out",)
    assert frames[0].origin.tolist() == [0, 0, 0]
    # a JSON file of something else beside it, and changed bytes
    (tmp_path / "a.json").write_text("[]")
    assert len(list(open_source(tmp_path / "a.pcap"))) == 4
    for content in with_changed_bytes((tmp_path / "a.pcap").read_bytes(), rng, 5):
        (tmp_path / "b.pcap").write_bytes(content)
        try:
            list(open_source(tmp_path / "b.pcap"))
        except InputError as error:
            assert "\n" not in str(error)
