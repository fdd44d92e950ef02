# SPDX-License-Identifier: Apache-2.0
"""Named configurations of the detector."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.datatypes import BevGrid
from manyeyes.models.detector.box_head import DecodeConfig
from manyeyes.models.detector.detector import DetectorConfig
from manyeyes.models.detector.encoder import EncoderConfig
from manyeyes.models.detector.transformer import AttentionConfig

SMALL_GRID = BevGrid(-70.4, -38.4, -5.0, 70.4, 38.4, 6.0)
OPV2V_GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 3.0)

SMALL_SQUARE_GRID = BevGrid(-70.4, -70.4, -5.0, 70.4, 70.4, 6.0)
"""Equal range in all directions: what lies beside one agent may lie ahead of another."""

BASE_GRID = BevGrid(-140.8, -38.4, -5.0, 140.8, 38.4, 6.0)
"""OPV2V's range, with the heights of costr-small: sensors on poles, and slopes."""

BASE_SQUARE_GRID = BevGrid(-140.8, -140.8, -5.0, 140.8, 140.8, 6.0)

DAIR_GRID = BevGrid(-102.4, -51.2, -5.0, 102.4, 51.2, 6.0)
"""Holds the ranges of all protocols on DAIR-V2X: CoSTr's 102.4 m x 102.4 m ahead, CoAlign's, HEAL's and SparseAlign's."""

DAIR_SQUARE_GRID = BevGrid(-102.4, -102.4, -5.0, 102.4, 102.4, 6.0)
"""Of the input: the roadside unit faces across the vehicle's road."""

COSTR_SMALL = DetectorConfig(
    grid=SMALL_GRID,
    pillars="moments",
    pillar_channels=32,
    encoder=EncoderConfig((32, 32, 64, 64, 64, 64), (0, 2, 2, 2, 1, 1), prune_strides=(2, 4)),
    head_channels=64,
    prune_threshold=0.1,
    decode=DecodeConfig(iou_score_weight=0.6),
    fusion="shift/fast",
    sweeps=2,
)
"""Half of OPV2V's range and a narrow network, with FAST on senders whose pose error is estimated from their tokens."""

COSTR_BASE = replace(COSTR_SMALL, grid=BASE_GRID)
"""The network of costr-small at OPV2V's full range."""

COSTR_OPV2V = DetectorConfig(
    grid=OPV2V_GRID,
    pillars="points",
    pillar_channels=64,
    encoder=EncoderConfig(prune_strides=(4, 8, 16, 32), head_stride=8),
    head_channels=128,
    decode=DecodeConfig(score_threshold=0.05),
    fusion="fast",
    sweeps=2,
)
"""Range and widths of the paper, with its head stride 8."""

COSTR_V2XSET = replace(COSTR_OPV2V, grid=BASE_GRID)
"""The same range and widths; heights reach lower and higher, for roadside units and slopes."""

COSTR_DAIR = replace(COSTR_OPV2V, grid=DAIR_SQUARE_GRID, output_range=DAIR_GRID, sweeps=1)
"""102.4 m ahead and behind, one sweep: pairs of DAIR-V2X are not evenly spaced in time."""

COSTR_V2X_REAL = replace(COSTR_V2XSET, classes=("vehicle", "pedestrian"))
"""V2X-Real's benchmark has trucks as a third class; here they are vehicles."""

COSTR_TINY = DetectorConfig(
    grid=BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0),
    pillars="moments",
    pillar_channels=16,
    encoder=EncoderConfig((16, 16, 32, 32, 32, 32), (0, 1, 1, 1, 1, 1), prune_strides=(4,)),
    dast=AttentionConfig(blocks=1, heads=2),
    fusion_attention=AttentionConfig(blocks=1, heads=2),
    head_channels=32,
    fusion="fast",
    sweeps=2,
)
"""For tests and examples, trains in seconds."""

DETECTORS = {
    "costr-small": COSTR_SMALL,
    "costr-base": COSTR_BASE,
    "costr-opv2v": COSTR_OPV2V,
    "costr-v2xset": COSTR_V2XSET,
    "costr-dair": COSTR_DAIR,
    "costr-v2x-real": COSTR_V2X_REAL,
    "costr-tiny": COSTR_TINY,
}
