"""Boxes as detectors draw them."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.synth.crop import draw_box
from lidarpose.synth.placement import Place
from lidarpose.synth.scene import SCENES

BODY = np.array([[x, y, z] for x in (-0.2, 0.3) for y in (-0.35, 0.35) for z in (0.0, 1.7)], np.float32)
EXTENT = (BODY.min(0).tolist(), BODY.max(0).tolist())
WILD = SCENES["wild"].crop


def place(yaw=0.0, feet=(6.0, -2.0, -1.5)):
    return Place(feet=np.array(feet), yaw=yaw, distance=6.3, R_sensor_level=None)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3, 3), st.floats(-3, 3))
def test_without_cuts_and_jitter_a_box_holds_the_body_along_its_heading(seed, yaw, turned):
    where = place(yaw)
    c, s = np.cos(turned), np.sin(turned)
    body = BODY @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)  # turned by `turned`
    errors = replace(WILD, jitter=1e-9, loose=0.0, cut=0.0)
    box = draw_box(errors, 1.0, EXTENT, where, np.random.default_rng(seed), heading=turned)
    offset = where.of_body(body.astype(float)) - box.center
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], -1)
    # aside from the bottom edge, which may lie above the soles
    assert (np.abs(local) <= box.size[:2] / 2 + 1e-5).all()
    assert (box.size[:2] < [0.5 + 0.26, 0.7 + 0.26]).all()
    assert offset[:, 2].max() <= box.size[2] / 2 + 1e-5


def test_the_bottom_edge_is_now_above_the_soles_now_in_the_ground():
    rng = np.random.default_rng(0)
    errors = replace(WILD, jitter=1e-9, loose=0.0, cut=0.0)
    boxes = [draw_box(errors, 1.0, EXTENT, place(), rng) for _ in range(600)]
    bottom = np.array([b.center[2] - b.size[2] / 2 + 1.5 for b in boxes])
    assert 0.05 < (bottom > 0).mean() < 0.3
    assert 0.15 < (bottom < -0.15).mean() < 0.5
    assert bottom.min() > -0.5 and bottom.max() < 0.2


def test_errors_are_as_large_as_configured():
    rng = np.random.default_rng(1)
    boxes = [draw_box(replace(WILD, loose=0.0, cut=0.0), 1.0, EXTENT, place(1.0), rng) for _ in range(800)]
    yaw = np.array([b.yaw for b in boxes]) - 1.0
    assert abs(yaw.std() - WILD.jitter) < 0.01 and abs(yaw.mean()) < 0.01
    loose = [draw_box(WILD, 0.0, EXTENT, place(), rng) for _ in range(800)]
    assert abs(np.mean([b.size[0] > 0.5 + 0.3 for b in loose]) - WILD.loose) < 0.04


def test_cuts_come_with_difficulty():
    rng = np.random.default_rng(2)
    always = replace(WILD, jitter=1e-9, loose=0.0, cut=1.0)
    easy, hard = (
        np.array([draw_box(always, how, EXTENT, place(), rng).size for _ in range(400)]) for how in (0.0, 1.0)
    )
    assert easy[:, 2].min() > 1.5
    # a cut takes 15 percent of a height or a side on average, heights in half of the cases
    lost = 1 - hard.mean(0) / easy.mean(0)
    assert 0.04 < lost[2] < 0.12 and 0.02 < lost[1] < 0.09 and 0.005 < lost[0] < 0.06


def test_the_paper_cuts_nothing():
    box = draw_box(SCENES["paper"].crop, 1.0, EXTENT, place(0.7), np.random.default_rng(3))
    assert box.contains(place(0.7).of_body(BODY.astype(float))).all()
    assert (box.size > 4).all()
