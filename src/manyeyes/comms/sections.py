# SPDX-License-Identifier: Apache-2.0
"""The bodies of packets: tokens, objects and points to rows of bytes and back, as :mod:`manyeyes.comms.wire` lays down."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.comms import codec
from manyeyes.comms.codec import PacketError
from manyeyes.datatypes import LABELS, BevGrid, Boxes, ConfigError, PointCloud, Sites, SparseBev, WireError

Precision = Literal["float32", "float16", "int8"]

PRECISIONS: tuple[Precision, ...] = ("float32", "float16", "int8")
# The middle of what drives in European cities.
LABEL_HEIGHTS = (1.6, 2.3, 3.2, 3.2)
NONE, TOKENS, OBJECTS, POINTS = range(4)

_GRID = struct.Struct("<6hHBBHH")
TOKENS_BYTES = _GRID.size
_OBJECT = np.dtype(
    [("xy", "<i2", 2), ("yaw", "<i2"), ("size", "u1", 2), ("score", "u1")]
    + [(name, "u1") for name in ("sigma_xy", "sigma_yaw", "label_flip", "id")]
)
_POINT = np.dtype([("xyz", "<i2", 3), ("intensity", "u1")])
_FEATURE_TYPES: dict[Precision, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float16": np.dtype("<f2"),
    "int8": np.dtype("i1"),
}
_MOST_CELLS = 1 << 24
_SIGMA_XY, _SIGMA_YAW = (0.01, 20.0), (0.001, 3.2)


@dataclass(frozen=True, eq=False)
class TokenRows:
    """Some cells of a grid: key (n,) ascending; scales and values: the bytes of C codes (none but for int8) and n rows of C."""

    grid: BevGrid
    precision: Precision
    channels: int
    key: NDArray[np.int64]
    scales: bytes
    values: bytes

    @property
    def features(self) -> NDArray[np.float32]:
        """(n, C) float32: what the values stand for."""
        return _features([self])


@dataclass(frozen=True, eq=False)
class ObjectRows:
    """Some objects, as they stand in the packet."""

    rows: NDArray[Any]


@dataclass(frozen=True, eq=False)
class PointRows:
    """Some points, as they stand in the packet."""

    rows: NDArray[Any]


Body = TokenRows | ObjectRows | PointRows | None


def check_precision(precision: str) -> None:
    """Raise ConfigError where precision is not one of PRECISIONS."""
    if precision not in PRECISIONS:
        raise ConfigError(f"precision is one of {', '.join(PRECISIONS)}; got {precision!r}.")


def _centimetres(metres: NDArray[np.floating[Any]], what: str) -> NDArray[np.int16]:
    """Metres as int16 centimetres; what does not fit is a WireError that names it."""
    codes = np.rint(metres.astype(np.float64) * 100)
    bad = ~(np.abs(codes) <= 32767)
    if bad.any():
        raise WireError(
            f"{what} are sent within 327.67 m of the agent; {int(bad.sum())} values are not: crop them first."
        )
    return codes.astype(np.int16)


def object_bodies(boxes: Boxes, capacity: int) -> list[bytes]:
    """Bodies of whole objects, the highest score first; no objects are one empty body."""
    boxes = boxes[boxes.score.argsort(descending=True, stable=True)]
    values = torch.cat(
        [
            boxes.center,
            boxes.size,
            torch.stack((boxes.yaw, boxes.score, boxes.sigma_xy, boxes.sigma_yaw, boxes.flip), -1),
        ],
        -1,
    )
    values = values.detach().double().cpu()
    if not bool(torch.isfinite(values).all()):
        raise WireError("Message.objects has NaN or infinite values; drop those objects before sending.")
    label = boxes.label.cpu().numpy()
    if len(label) and not (label.min() >= 0 and label.max() < len(LABELS)):
        raise WireError(
            f"Message.objects.label is an index into {LABELS}; got {int(label.min())} to {int(label.max())}."
        )
    v = values.numpy()
    rows = np.zeros(len(boxes), _OBJECT)
    rows["xy"] = _centimetres(v[:, :2], "Objects")
    hundredths = np.rint(np.rad2deg(v[:, 6]) * 100)
    rows["yaw"] = np.mod(hundredths + 18000, 36000) - 18000
    rows["size"] = np.clip(np.rint(v[:, 3:5] * 10), 1, 255)
    rows["score"] = np.rint(np.clip(v[:, 7], 0, 1) * 255)
    rows["sigma_xy"] = codec.log_codes(v[:, 8], *_SIGMA_XY)
    rows["sigma_yaw"] = codec.log_codes(v[:, 9], *_SIGMA_YAW)
    rows["label_flip"] = label | np.rint(np.clip(v[:, 10], 0, 1) * 31).astype(np.int64) << 3
    ids = boxes.id.cpu().numpy()
    rows["id"] = np.where(ids < 0, 255, np.mod(ids, 255))
    each = capacity // _OBJECT.itemsize
    return [rows[i : i + each].tobytes() for i in range(0, max(len(rows), 1), each)]


def point_bodies(cloud: PointCloud, capacity: int) -> list[bytes]:
    """Bodies of whole points, dealt out in turn; no points are one empty body."""
    rows = np.zeros(len(cloud), _POINT)
    rows["xyz"] = _centimetres(cloud.xyz.cpu().numpy(), "Points")
    rows["intensity"] = np.rint(np.clip(np.nan_to_num(cloud.intensity.cpu().numpy()), 0, 1) * 255)
    packets = max(1, -(-len(rows) // (capacity // _POINT.itemsize)))
    return [rows[k::packets].tobytes() for k in range(packets)]


def token_order(tokens: SparseBev, score: Tensor | None) -> NDArray[np.int64]:
    """(N,) rows of tokens by falling score, ties and a missing score by key: the order in which they are sent."""
    if tokens.sites.batch_size != 1:
        raise WireError(f"A message has the tokens of one grid; got a batch of {tokens.sites.batch_size}.")
    if score is None:
        return np.arange(len(tokens.sites))
    if score.shape != (len(tokens.sites),) or bool(score.isnan().any()):
        raise WireError(f"Message.token_score needs ({len(tokens.sites)},) without NaN; got {tuple(score.shape)}.")
    return score.detach().argsort(descending=True, stable=True).cpu().numpy()


def packet_counts(
    key: NDArray[np.int64],
    channels: int,
    precision: Precision,
    capacity: int,
    header_bytes: int = 0,
    budget_bytes: int | None = None,
) -> list[int]:
    """How many cells each tokens packet takes, in the order of key (N,): bodies of at most capacity bytes.

    Bodies with header_bytes each take at most budget_bytes altogether. Each packet is filled before the next is begun,
    so a smaller budget keeps a prefix of what a larger one keeps.
    """
    each = channels * _FEATURE_TYPES[precision].itemsize
    fixed = TOKENS_BYTES + (channels if precision == "int8" else 0)
    if channels < 1 or channels > 65535 or fixed + each + 5 > capacity:
        raise WireError(
            f"One cell of {channels} channels as {precision} does not fit a body of {capacity} bytes: lower the "
            "precision or raise the mtu."
        )
    left = -1 if budget_bytes is None else max(0, budget_bytes)
    return codec.counts_in_room(np.ascontiguousarray(key, np.int64), each, fixed, capacity, header_bytes, left).tolist()


def _grid_fields(grid: BevGrid) -> tuple[int, ...]:
    """The grid as the integers of the format; a grid that they do not name exactly is a WireError."""
    ends = (grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max)
    fields = (*(round(v * 100) for v in ends), round(grid.pillar * 1000), grid.stride)
    rows, columns = grid.shape
    if (
        any(abs(v) > 32767 for v in fields[:6])
        or fields[6] > 65535
        or _grid(fields) != grid
        or rows * columns > _MOST_CELLS
    ):
        raise WireError(
            "A grid is sent in whole centimetres within 327.67 m, a pillar in whole millimetres, at most 2^24 cells; "
            f"got {grid}."
        )
    return fields


@lru_cache(maxsize=64)
def _grid(fields: tuple[int, ...]) -> BevGrid:
    # A correctly rounded quotient gives back the very float that 140.8 is in the source of both sides.
    return BevGrid(*(v / 100 for v in fields[:6]), pillar=fields[6] / 1000, stride=fields[7])


@lru_cache(maxsize=64)
def _grid_and_cells(fields: tuple[int, ...]) -> tuple[BevGrid, int]:
    grid = _grid(fields)
    rows, columns = grid.shape
    return grid, rows * columns


def token_bodies(tokens: SparseBev, score: Tensor | None, precision: Precision, capacity: int) -> list[bytes]:
    """The bodies of the tokens packets, the cells of highest score in the first."""
    order = token_order(tokens, score)
    key = tokens.sites.key.cpu().numpy()[order]
    features = tokens.features.detach().float().cpu()
    largest, peak = 65504 if precision == "float16" else math.inf, 0.0
    if features.numel():
        peak = float(features.abs().max())
    if not (math.isfinite(peak) and peak <= largest):
        raise WireError(f"Features sent as {precision} must be finite and at most {largest:g}; these are not.")
    grid, channels = _grid_fields(tokens.grid), features.shape[1]
    counts = packet_counts(key, channels, precision, capacity) or [0]
    # All bodies at once, each with its cells in ascending order.
    inner = np.argsort(np.repeat(np.arange(len(counts)) * _MOST_CELLS, counts) + key)
    cells = codec.pack_cell_runs(key[inner], counts)
    values, scales = _values(features.index_select(0, torch.from_numpy(order[inner])), precision, counts)
    form = PRECISIONS.index(precision)
    heads = [_GRID.pack(*grid, form | layout << 2, channels, 0)[:-2] for layout in (codec.DELTA, codec.BITMAP)]
    each, bodies, at = channels * _FEATURE_TYPES[precision].itemsize, [], 0
    for count, (layout, packed), scale in zip(counts, cells, scales):
        end = at + count * each
        bodies.append(b"".join((heads[layout], count.to_bytes(2, "little"), packed, scale, values[at:end])))
        at = end
    return bodies


def _values(features: Tensor, precision: Precision, counts: list[int]) -> tuple[bytes, list[bytes]]:
    """Features (N, C) as the bytes of their rows, and the bytes of each body's scales; counts: the rows of each body."""
    if precision == "int8":
        codes, steps = codec.quantise_int8_runs(features.numpy(), counts)
        return steps.tobytes(), [code.tobytes() for code in codes]
    # Several times as fast here as numpy's conversion, to the same bits.
    rows = (features.half() if precision == "float16" else features).numpy()
    return rows.astype(_FEATURE_TYPES[precision], copy=False).tobytes(), [b""] * len(counts)


def read_body(kind: int, body: bytes) -> TokenRows | ObjectRows | PointRows | None:
    """The rows of a body, checked; whatever is wrong is a PacketError with a reason."""
    if kind == TOKENS:
        return _read_tokens(body)
    if kind == NONE:
        if body:
            raise PacketError("garbage", f"A packet without a section has {len(body)} bytes of body.")
        return None
    dtype = _OBJECT if kind == OBJECTS else _POINT
    if len(body) % dtype.itemsize:
        raise PacketError("garbage", f"Rows of {dtype.itemsize} bytes do not fill a body of {len(body)}.")
    rows = np.frombuffer(body, dtype)
    if kind == POINTS:
        return PointRows(rows)
    good = (rows["label_flip"] & 7 < len(LABELS)) & (rows["size"] > 0).all(-1)
    good &= (rows["yaw"] >= -18000) & (rows["yaw"] < 18000)
    if not good.all():
        raise PacketError(
            "implausible", f"{int((~good).sum())} objects have an unknown label, no size, or a yaw over 180°."
        )
    return ObjectRows(rows)


def _read_tokens(body: bytes) -> TokenRows:
    if len(body) < _GRID.size:
        raise PacketError("garbage", f"A tokens body begins with {_GRID.size} bytes; got {len(body)}.")
    *fields, form, channels, count = _GRID.unpack_from(body)
    if form >> 3 or form & 3 >= len(PRECISIONS) or not channels:
        raise PacketError("garbage", f"Unknown form of tokens: {form:#04x}, {channels} channels.")
    try:
        grid, cells = _grid_and_cells(tuple(fields))
    except ConfigError as error:
        raise PacketError("implausible", str(error)) from error
    key, used = codec.unpack_cells(form >> 2, body[_GRID.size :], count)
    if cells > _MOST_CELLS or (count and int(key[-1]) >= cells):
        rows, columns = grid.shape
        raise PacketError(
            "implausible", f"Cells lie outside a grid of {rows} rows and {columns} columns (or it is huge)."
        )
    precision, at = PRECISIONS[form & 3], _GRID.size + used
    size = _FEATURE_TYPES[precision].itemsize
    end = at + (channels if precision == "int8" else 0)
    if len(body) != end + count * channels * size:
        raise PacketError(
            "garbage", f"{count} cells of {channels} channels as {precision} do not fill {len(body)} bytes."
        )
    if size > 1 and not codec.are_finite(body, at, size):
        raise PacketError("implausible", "Features are NaN or infinite.")
    return TokenRows(grid, precision, channels, key, body[at:end], body[end:])


def merge_tokens(parts: list[TokenRows]) -> SparseBev | None:
    """The cells of several packets, all of one form, as one set, by key; None of none."""
    if not parts:
        return None
    key = np.concatenate([p.key for p in parts])
    order = np.argsort(key)
    features = torch.from_numpy(_features(parts)).index_select(0, torch.from_numpy(order))
    return SparseBev(features, Sites(torch.from_numpy(key[order]), parts[0].grid))


def _features(parts: list[TokenRows]) -> NDArray[np.float32]:
    """(n, C) float32 of the rows of several packets of one form."""
    dtype, channels = _FEATURE_TYPES[parts[0].precision], parts[0].channels
    # A copy that may be written to, in the machine's own order of bytes.
    values = np.frombuffer(b"".join(p.values for p in parts), dtype).astype(dtype.newbyteorder("="))
    values = values.reshape(-1, channels)
    if parts[0].precision == "int8":
        codes = np.frombuffer(b"".join(p.scales for p in parts), np.uint8).reshape(-1, channels)
        return codec.dequantise_int8(np.repeat(codes, [len(p.key) for p in parts], axis=0), values)
    return torch.from_numpy(values).float().numpy()


def merge_objects(parts: list[NDArray[Any]]) -> Boxes | None:
    """The objects of several packets, in that order, with height and z from their labels; None of none."""
    if not parts:
        return None
    rows = np.concatenate(parts)
    label = torch.from_numpy((rows["label_flip"] & 7).astype(np.int64))
    height = torch.tensor(LABEL_HEIGHTS)[label]
    ids = rows["id"].astype(np.int64)
    return Boxes(
        center=torch.cat((torch.from_numpy(rows["xy"].astype(np.float32) / 100), height[:, None] / 2), -1),
        size=torch.cat((torch.from_numpy(rows["size"].astype(np.float32) / 10), height[:, None]), -1),
        yaw=torch.from_numpy(np.deg2rad(rows["yaw"] / 100).astype(np.float32)),
        score=torch.from_numpy(rows["score"].astype(np.float32) / 255),
        label=label,
        id=torch.from_numpy(np.where(ids == 255, -1, ids)),
        sigma_xy=torch.from_numpy(codec.log_values(rows["sigma_xy"], *_SIGMA_XY)),
        sigma_yaw=torch.from_numpy(codec.log_values(rows["sigma_yaw"], *_SIGMA_YAW)),
        flip=torch.from_numpy((rows["label_flip"] >> 3).astype(np.float32) / 31),
        velocity=torch.zeros(len(rows), 2),
    )


def merge_points(parts: list[NDArray[Any]]) -> PointCloud | None:
    """The points of several packets in the sender's order, less those lost; None of none."""
    if not parts:
        return None
    # Packet k of K holds points k, k + K, …: sorting by place within the packet restores the order.
    place = np.concatenate([np.arange(len(p)) for p in parts])
    rows = np.concatenate(parts)[np.argsort(place, kind="stable")]
    xyz = torch.from_numpy(rows["xyz"].astype(np.float32) / 100)
    return PointCloud.of(xyz, torch.from_numpy(rows["intensity"].astype(np.float32) / 255))
