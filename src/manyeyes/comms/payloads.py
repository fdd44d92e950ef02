# SPDX-License-Identifier: Apache-2.0
"""The bodies of packets: tokens, objects, points, requests, sights to bytes and back, as :mod:`manyeyes.comms.wire` lays down.

Those of map elements stand in :mod:`manyeyes.comms.map_payload`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.comms import primitives
from manyeyes.comms.cluster_payload import (
    HEAD_BYTES,
    count_fitting_clustered_cells,
    join_clustered,
    order_by_cluster,
    pack_clustered,
    read_clustered,
)
from manyeyes.comms.entropy import MAX_CODED_CELLS, CodeTables, count_fitting_coded_cells, pack_coded, unpack_coded
from manyeyes.comms.map_payload import ElementRows, read_elements
from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes import LABELS, BevGrid, Boxes, ConfigError, PointCloud, Sites, SparseBev, WireError
from manyeyes.datatypes.message import DESCRIPTOR_DIM, RequestMap
from manyeyes.datatypes.sight import NUM_SECTORS, Sight

TokenEncoding = Literal["float32", "float16", "int8", "codebook", "clusters"]

TOKEN_ENCODINGS: tuple[TokenEncoding, ...] = ("float32", "float16", "int8", "codebook", "clusters")
# The middle of what drives in European cities.
LABEL_HEIGHTS = (1.6, 2.3, 3.2, 3.2, 1.7, 1.7, 1.6)
NONE, TOKENS, OBJECTS, POINTS, REQUEST, ELEMENTS, SIGHT = range(7)

_GRID = struct.Struct("<6hHB")
_TOKENS = struct.Struct("<BHH")
TOKENS_BYTES = _GRID.size + _TOKENS.size
_VELOCITY, _DESCRIPTOR = 1, 2
_METRES_PER_S = 0.25
_POINT = np.dtype([("xyz", "<i2", 3), ("intensity", "u1")])
_FEATURE_TYPES: dict[TokenEncoding, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float16": np.dtype("<f2"),
    "int8": np.dtype("i1"),
    "codebook": np.dtype("u1"),
    "clusters": np.dtype("u1"),
}
_CODED, _CLUSTERED = 2, 1 << 4
_MAX_CELLS = 1 << 24
_SIGMA_XY, _SIGMA_YAW = (0.01, 20.0), (0.001, 3.2)


@dataclass(frozen=True, eq=False)
class TokenRows:
    """Some cells of a grid: key (n,) ascending; scales and values: the bytes of C scale codes (none but for int8) and n rows
    of C.

    Of clusters, scales are the rows of the clusters, C float16 each, and values n rows of the number of a cluster and own_bytes.
    """

    grid: BevGrid
    encoding: TokenEncoding
    channels: int
    key: NDArray[np.int64]
    scales: bytes
    values: bytes
    own_bytes: int = 0

    @property
    def form(self) -> tuple[BevGrid, TokenEncoding, int, int]:
        """What the packets of one message have in common."""
        return self.grid, self.encoding, self.channels, self.own_bytes

    @property
    def width(self) -> int:
        """Number of values of a row of ``features``."""
        return 2 * self.channels + self.own_bytes if self.encoding == "clusters" else self.channels

    @property
    def features(self) -> NDArray[Any]:
        """(n, C) float32, what the values stand for; uint8 where they are codes or of clusters."""
        return _features([self])


@dataclass(frozen=True, eq=False)
class ObjectRows:
    """Some objects, as they stand in the packet."""

    rows: NDArray[Any]


@dataclass(frozen=True, eq=False)
class PointRows:
    """Some points, as they stand in the packet."""

    rows: NDArray[Any]


Body = TokenRows | ObjectRows | PointRows | RequestMap | ElementRows | Sight | None


def _centimetres(metres: NDArray[np.floating[Any]], what: str) -> NDArray[np.int16]:
    """Convert metres to int16 centimetres; what does not fit is a WireError that names it."""
    codes = np.rint(metres.astype(np.float64) * 100)
    bad = ~(np.abs(codes) <= 32767)
    if bad.any():
        raise WireError(
            f"{what} are sent within 327.67 m of the agent; {int(bad.sum())} values are not: crop them first."
        )
    return codes.astype(np.int16)


@lru_cache(maxsize=8)
def _object_type(flags: int, has_fine_scores: bool = True) -> np.dtype[Any]:
    """Return the row of an object, with what the flags of its body add; has_fine_scores: not of versions 2 and 3."""
    places = [("xy", "<i2", 2), ("yaw", "<i2"), ("size", "u1", 2), ("score", "<u2" if has_fine_scores else "u1")]
    rest = [(name, "u1") for name in ("sigma_xy", "sigma_yaw", "label_flip", "id")]
    velocity = [("velocity", "i1", 2)] if flags & _VELOCITY else []
    descriptor = [("descriptor", "i1", DESCRIPTOR_DIM)] if flags & _DESCRIPTOR else []
    return np.dtype([*places, *rest, *velocity, *descriptor])


def pack_object_bodies(boxes: Boxes, descriptors: Tensor | None, capacity: int) -> list[bytes]:
    """Return bodies of whole objects, the highest score first; no objects are one body without rows.

    Velocities are sent where any of them is not 0, descriptors where there are any.
    """
    order = boxes.score.argsort(descending=True, stable=True)
    boxes = boxes[order]
    values = torch.cat(
        [
            boxes.center,
            boxes.size,
            torch.stack((boxes.yaw, boxes.score, boxes.sigma_xy, boxes.sigma_yaw, boxes.p_flip), -1),
            boxes.velocity,
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
    velocity = np.clip(np.rint(v[:, 11:] / _METRES_PER_S), -127, 127)
    flags = (_VELOCITY if velocity.any() else 0) | (_DESCRIPTOR if descriptors is not None else 0)
    rows = np.zeros(len(boxes), _object_type(flags))
    rows["xy"] = _centimetres(v[:, :2], "Objects")
    hundredths = np.rint(np.rad2deg(v[:, 6]) * 100)
    rows["yaw"] = np.mod(hundredths + 18000, 36000) - 18000
    rows["size"] = np.clip(np.rint(v[:, 3:5] * 10), 1, 255)
    rows["score"] = np.rint(np.clip(v[:, 7], 0, 1) * 65535)
    rows["sigma_xy"] = primitives.log_codes(v[:, 8], *_SIGMA_XY)
    rows["sigma_yaw"] = primitives.log_codes(v[:, 9], *_SIGMA_YAW)
    rows["label_flip"] = label | np.rint(np.clip(v[:, 10], 0, 1) * 31).astype(np.int64) << 3
    ids = boxes.id.cpu().numpy()
    rows["id"] = np.where(ids < 0, 255, np.mod(ids, 255))
    if flags & _VELOCITY:
        rows["velocity"] = velocity
    if descriptors is not None:
        rows["descriptor"] = _descriptor_codes(descriptors, len(boxes))[order.cpu().numpy()]
    each, head = (capacity - 1) // rows.dtype.itemsize, bytes([flags])
    return [head + rows[i : i + each].tobytes() for i in range(0, max(len(rows), 1), each)]


def _descriptor_codes(descriptors: Tensor, count: int) -> NDArray[np.int8]:
    values = descriptors.detach().double().cpu()
    if tuple(values.shape) != (count, DESCRIPTOR_DIM) or not bool((values.abs() <= 1).all()):
        raise WireError(
            f"Message.descriptors needs ({count}, {DESCRIPTOR_DIM}) in [-1, 1], one an object; got {tuple(values.shape)}."
        )
    return np.rint(values.numpy() * 127).astype(np.int8)


def pack_point_bodies(cloud: PointCloud, capacity: int) -> list[bytes]:
    """Return bodies of whole points, dealt out in turn; no points are one empty body."""
    rows = np.zeros(len(cloud), _POINT)
    rows["xyz"] = _centimetres(cloud.xyz.cpu().numpy(), "Points")
    rows["intensity"] = np.rint(np.clip(np.nan_to_num(cloud.intensity.cpu().numpy()), 0, 1) * 255)
    packets = max(1, -(-len(rows) // (capacity // _POINT.itemsize)))
    return [rows[k::packets].tobytes() for k in range(packets)]


def token_order(tokens: SparseBev, score: Tensor | None) -> NDArray[np.int64]:
    """Return (N,) rows of tokens by falling score, ties and a missing score by key: the order in which they are sent."""
    if tokens.sites.batch_size != 1:
        raise WireError(f"A message has the tokens of one grid; got a batch of {tokens.sites.batch_size}.")
    if score is None:
        return np.arange(len(tokens.sites))
    if score.shape != (len(tokens.sites),) or bool(score.isnan().any()):
        raise WireError(f"Message.token_score needs ({len(tokens.sites)},) without NaN; got {tuple(score.shape)}.")
    return score.detach().argsort(descending=True, stable=True).cpu().numpy()


@dataclass(frozen=True)
class TokenCodec:
    """Token encoding, and entropy coding tables of codes; None sends their bytes uncoded.

    own_bytes: last bytes of a row of clusters, which are the token's own.
    """

    encoding: TokenEncoding
    tables: CodeTables | None = None
    own_bytes: int = 0

    def __post_init__(self) -> None:
        if self.encoding not in TOKEN_ENCODINGS:
            raise ConfigError(f"token encoding is one of {', '.join(TOKEN_ENCODINGS)}; got {self.encoding!r}.")

    def order(self, tokens: SparseBev, score: Tensor | None) -> NDArray[np.int64]:
        """Return (N,) rows of tokens in the order in which they are sent: by falling score, of clusters cluster by cluster."""
        order = token_order(tokens, score)
        if self.encoding != "clusters" or tokens.features.dtype != torch.uint8:
            return order
        return order_by_cluster(tokens.features.cpu().numpy(), self.own_bytes, order)

    def count_channels(self, tokens: SparseBev) -> int:
        """Return the number of channels of a row as it is sent; of clusters, that of the float16 channels."""
        width = tokens.features.shape[1]
        if self.encoding != "clusters":
            return width
        if width <= self.own_bytes or (width - self.own_bytes) % 2:
            raise WireError(f"A row of {width} bytes is not one of float16 and {self.own_bytes} own bytes.")
        return (width - self.own_bytes) // 2

    def select_tables(self, tokens: SparseBev) -> CodeTables | None:
        """Return the tables, where these tokens are to be coded by them; tokens of another encoding are a WireError."""
        codes = tokens.features.dtype == torch.uint8
        if codes != (self.encoding in ("codebook", "clusters")):
            raise WireError(
                f"Tokens of {tokens.features.dtype} are not sent as {self.encoding}: codes are uint8 rows of the model's "
                "codebook or of clusters, and only codes are."
            )
        if self.encoding != "codebook" or self.tables is None:
            return None
        if self.tables.width != tokens.features.shape[1]:
            raise WireError(
                f"The tables are of rows of {self.tables.width} bytes; these have {tokens.features.shape[1]}."
            )
        rows, columns = tokens.grid.shape
        return self.tables if rows * columns <= MAX_CODED_CELLS else None


def count_cells_per_packet(
    tokens: SparseBev,
    order: NDArray[np.int64],
    token_codec: TokenCodec,
    capacity: int,
    header_bytes: int = 0,
    budget_bytes: int | None = None,
) -> list[int]:
    """Return how many cells each tokens packet takes, in that order (N,) of rows: bodies of at most capacity bytes.

    Bodies with header_bytes each take at most budget_bytes altogether. Each packet is filled before the next is begun,
    so a smaller budget keeps a prefix of what a larger one keeps.
    """
    channels, encoding, tables = (
        token_codec.count_channels(tokens),
        token_codec.encoding,
        token_codec.select_tables(tokens),
    )
    bytes_per_cell = tokens.features.shape[1] * _FEATURE_TYPES[encoding].itemsize
    fixed_bytes = TOKENS_BYTES + (channels if encoding == "int8" else HEAD_BYTES + 1 if encoding == "clusters" else 0)
    if channels < 1 or channels > 65535 or fixed_bytes + bytes_per_cell + 5 > capacity:
        raise WireError(
            f"One cell of {channels} channels as {encoding} does not fit a body of {capacity} bytes: use a "
            "smaller token encoding or raise the mtu."
        )
    key = np.ascontiguousarray(tokens.sites.key.cpu().numpy()[order], np.int64)
    bytes_left = -1 if budget_bytes is None else max(0, budget_bytes)
    if encoding == "clusters":
        rows = tokens.features.cpu().numpy()[order]
        limits = (TOKENS_BYTES, capacity, header_bytes, bytes_left)
        return count_fitting_clustered_cells(key, rows, token_codec.own_bytes, *limits).tolist()
    if tables is None:
        return primitives.count_fitting_cells(
            key, bytes_per_cell, fixed_bytes, capacity, header_bytes, bytes_left
        ).tolist()
    rows = tokens.features.cpu().numpy()[order]
    return count_fitting_coded_cells(
        key, rows, tokens.grid.shape, tables, fixed_bytes, capacity, header_bytes, bytes_left
    ).tolist()


def _grid_fields(grid: BevGrid) -> tuple[int, ...]:
    """Return the grid as the integers of the format; a grid that they do not name exactly is a WireError."""
    ends = (grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max)
    fields = (*(round(v * 100) for v in ends), round(grid.pillar * 1000), grid.stride)
    rows, columns = grid.shape
    if (
        any(abs(v) > 32767 for v in fields[:6])
        or fields[6] > 65535
        or _grid(fields) != grid
        or rows * columns > _MAX_CELLS
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


def pack_token_bodies(
    tokens: SparseBev,
    score: Tensor | None,
    token_codec: TokenCodec,
    capacity: int,
    counts: Sequence[int] | None = None,
) -> list[bytes]:
    """Return the bodies of the tokens packets, the cells of highest score in the first.

    counts: the result of :func:`count_cells_per_packet` for these tokens, if it is known.
    """
    order = token_codec.order(tokens, score)
    key, encoding = tokens.sites.key.cpu().numpy()[order], token_codec.encoding
    features = tokens.features.detach().cpu()
    features = features if features.dtype == torch.uint8 else features.float()
    largest, peak = 65504 if encoding == "float16" else math.inf, 0.0
    if features.numel() and features.dtype != torch.uint8:
        peak = float(features.abs().max())
    if not (math.isfinite(peak) and peak <= largest):
        raise WireError(f"Features sent as {encoding} must be finite and at most {largest:g}; these are not.")
    grid, channels = _GRID.pack(*_grid_fields(tokens.grid)), token_codec.count_channels(tokens)
    if counts is None:
        counts = count_cells_per_packet(tokens, order, token_codec, capacity)
    counts = list(counts) or [0]
    # All bodies at once, each with its cells in ascending order.
    inner = np.argsort(np.repeat(np.arange(len(counts)) * _MAX_CELLS, counts) + key)
    key, features = key[inner], features.index_select(0, torch.from_numpy(order[inner]))
    number, tables = TOKEN_ENCODINGS.index(encoding), token_codec.select_tables(tokens)

    def head(layout: int, count: int) -> bytes:
        return grid + _TOKENS.pack(number | layout << 2, channels, count)

    rows, ends = features.numpy(), np.cumsum([0, *counts])
    if encoding == "clusters":
        number, bodies = TOKEN_ENCODINGS.index("float16") | _CLUSTERED, list[bytes]()
        for a, b in pairwise(ends.tolist()):
            layout, content = pack_clustered(key[a:b], rows[a:b], token_codec.own_bytes)
            bodies.append(head(layout, b - a) + content)
        return bodies
    if tables is not None:
        return [
            head(_CODED, b - a) + pack_coded(key[a:b], rows[a:b], tokens.grid.shape, tables)
            for a, b in pairwise(ends.tolist())
        ]
    cells = primitives.pack_cell_runs(key, counts)
    values, scales = _values(features, encoding, counts)
    each, bodies, at = channels * _FEATURE_TYPES[encoding].itemsize, [], 0
    for count, (layout, packed), scale in zip(counts, cells, scales):
        end = at + count * each
        bodies.append(b"".join((head(layout, count), packed, scale, values[at:end])))
        at = end
    return bodies


def pack_request_body(request: RequestMap, capacity: int) -> bytes:
    """Return the body of the one packet of a request map."""
    confidence = request.confidence.detach().double().cpu()
    if not bool(((confidence >= 0) & (confidence <= 1)).all()):
        raise WireError("Message.request.confidence is from 0 to 1; this is not.")
    if _GRID.size + confidence.numel() > capacity:
        raise WireError(
            f"A request map fits one packet, {capacity - _GRID.size} cells; got {confidence.numel()}: use a coarser grid."
        )
    return _GRID.pack(*_grid_fields(request.grid)) + np.rint(confidence.numpy() * 255).astype(np.uint8).tobytes()


def pack_sight_body(sight: Sight, capacity: int) -> bytes:
    """Return the body of the one packet of a sight: one byte a sector."""
    if capacity < NUM_SECTORS:
        raise WireError(f"A sight fits one packet, {NUM_SECTORS} bytes; a body has {capacity}: raise the mtu.")
    return sight.steps.tobytes()


def _values(features: Tensor, encoding: TokenEncoding, counts: list[int]) -> tuple[bytes, list[bytes]]:
    """Return features (N, C) as the bytes of their rows, and the bytes of each body's scales; counts: the rows of each body."""
    if encoding == "int8":
        codes, steps = primitives.quantise_int8_runs(features.numpy(), counts)
        return steps.tobytes(), [code.tobytes() for code in codes]
    if encoding == "codebook":
        return features.numpy().tobytes(), [b""] * len(counts)
    # Several times as fast here as numpy's conversion, to the same bits.
    rows = (features.half() if encoding == "float16" else features).numpy()
    return rows.astype(_FEATURE_TYPES[encoding], copy=False).tobytes(), [b""] * len(counts)


def read_body(
    kind: int, body: bytes, fingerprint: bytes, tables: CodeTables | None, has_fine_scores: bool = True
) -> Body:
    """Return the rows of a body, checked; whatever is wrong is a PacketError with a reason.

    tables: of the reader's weights; coded tokens can only be read by those that the packet's fingerprint names.
    has_fine_scores: of objects, whose scores have two bytes; false of versions 2 and 3.
    """
    if kind == TOKENS:
        return _read_tokens(body, fingerprint, tables)
    if kind == OBJECTS:
        return _read_objects(body, has_fine_scores)
    if kind == REQUEST:
        return _read_request(body)
    if kind == ELEMENTS:
        return read_elements(body)
    if kind == POINTS:
        return PointRows(_rows(body, _POINT))
    if kind == SIGHT:
        return _read_sight(body)
    if kind != NONE or body:
        raise PacketError("garbage", f"A body of kind {kind} and {len(body)} bytes is not known.")
    return None


def claimed_cells(packet: bytes, at: int) -> int:
    """Return the number of cells in the head of a body of tokens, which begins at this place; 0 of a truncated one."""
    return _TOKENS.unpack_from(packet, at + _GRID.size)[2] if len(packet) >= at + TOKENS_BYTES else 0


def count_rows(kind: int, body: bytes, has_fine_scores: bool = True) -> int:
    """Return the number of cells, objects or points in a body of own packets, which is not checked; 0 of other kinds."""
    if kind == TOKENS:
        return claimed_cells(body, 0)
    if kind == OBJECTS:
        return (len(body) - 1) // _object_type(body[0], has_fine_scores).itemsize
    return len(body) // _POINT.itemsize if kind == POINTS else 0


def _rows(body: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    if len(body) % dtype.itemsize:
        raise PacketError("garbage", f"Rows of {dtype.itemsize} bytes do not fill a body of {len(body)}.")
    return np.frombuffer(body, dtype)


def _read_objects(body: bytes, has_fine_scores: bool) -> ObjectRows:
    if not body or body[0] & ~(_VELOCITY | _DESCRIPTOR):
        raise PacketError("garbage", "A body of objects begins with its flags, of which two are known.")
    rows = _rows(body[1:], _object_type(body[0], has_fine_scores))
    good = (rows["label_flip"] & 7 < len(LABELS)) & (rows["size"] > 0).all(-1)
    good &= (rows["yaw"] >= -18000) & (rows["yaw"] < 18000)
    for name in set(rows.dtype.names or ()) & {"velocity", "descriptor"}:
        good &= (rows[name] > -128).all(-1)
    if not good.all():
        raise PacketError(
            "implausible", f"{int((~good).sum())} objects have an unknown label, no size, or a number out of range."
        )
    return ObjectRows(rows)


def _read_grid(body: bytes) -> tuple[BevGrid, int]:
    """Return the grid that a body begins with, and its cells."""
    if len(body) < _GRID.size:
        raise PacketError("garbage", f"A grid has {_GRID.size} bytes; got {len(body)}.")
    try:
        grid, cells = _grid_and_cells(_GRID.unpack_from(body))
    except ConfigError as error:
        raise PacketError("implausible", str(error)) from error
    if cells > _MAX_CELLS:
        raise PacketError("implausible", f"A grid of {cells} cells is huge.")
    return grid, cells


def _read_request(body: bytes) -> RequestMap:
    grid, cells = _read_grid(body)
    if len(body) != _GRID.size + cells:
        raise PacketError("garbage", f"A request of {cells} cells does not fill a body of {len(body)} bytes.")
    confidence = np.frombuffer(body, np.uint8, offset=_GRID.size).astype(np.float32) / 255
    return RequestMap(grid, torch.from_numpy(confidence).view(grid.shape))


def _read_sight(body: bytes) -> Sight:
    if len(body) != NUM_SECTORS:
        raise PacketError("garbage", f"A sight has {NUM_SECTORS} bytes, one a sector; got {len(body)}.")
    return Sight(np.frombuffer(body, np.uint8))


def _read_tokens(body: bytes, fingerprint: bytes, tables: CodeTables | None) -> TokenRows:
    if len(body) < TOKENS_BYTES:
        raise PacketError("garbage", f"A tokens body begins with {TOKENS_BYTES} bytes; got {len(body)}.")
    grid, cells = _read_grid(body)
    layout_byte, channels, count = _TOKENS.unpack_from(body, _GRID.size)
    if layout_byte & _CLUSTERED:
        return _read_clusters(body, grid, cells)
    encoding, layout, data = TOKEN_ENCODINGS[layout_byte & 3], layout_byte >> 2, body[TOKENS_BYTES:]
    if layout > (_CODED if encoding == "codebook" else primitives.BITMAP) or not channels:
        raise PacketError("garbage", f"Unknown form of tokens: {layout_byte:#04x}, {channels} channels.")
    if layout == _CODED:
        if tables is None or tables.fingerprint != fingerprint:
            raise PacketError("wrong_model", "These tokens are coded by the tables of other weights.")
        if tables.width != channels or cells > MAX_CODED_CELLS or count > cells:
            raise PacketError(
                "implausible", f"{count} coded rows of {channels} bytes on {cells} cells are not of this model."
            )
        key, rows = unpack_coded(data, count, grid.shape, tables)
        return TokenRows(grid, encoding, channels, key, b"", rows.tobytes())
    key, used = primitives.unpack_cells(layout, data, count)
    if count and int(key[-1]) >= cells:
        raise PacketError("implausible", f"Cells lie outside a grid of {grid.shape} rows and columns.")
    size = _FEATURE_TYPES[encoding].itemsize
    end = used + (channels if encoding == "int8" else 0)
    if len(data) != end + count * channels * size:
        raise PacketError(
            "garbage", f"{count} cells of {channels} channels as {encoding} do not fill {len(body)} bytes."
        )
    if size > 1 and not primitives.are_finite(data, used, size):
        raise PacketError("implausible", "Features are NaN or infinite.")
    return TokenRows(grid, encoding, channels, key, data[used:end], data[end:])


def _read_clusters(body: bytes, grid: BevGrid, cells: int) -> TokenRows:
    layout_byte, channels, count = _TOKENS.unpack_from(body, _GRID.size)
    encoding, layout = TOKEN_ENCODINGS[layout_byte & 3], (layout_byte & ~_CLUSTERED) >> 2
    if encoding != "float16" or layout > primitives.BITMAP or not channels:
        raise PacketError("garbage", f"Unknown form of clusters: {layout_byte:#04x}, {channels} channels.")
    key, table, tokens, own_bytes = read_clustered(layout, body[TOKENS_BYTES:], count, channels)
    if count and int(key[-1]) >= cells:
        raise PacketError("implausible", f"Cells lie outside a grid of {grid.shape} rows and columns.")
    return TokenRows(grid, "clusters", channels, key, table, tokens, own_bytes)


def merge_tokens(parts: list[TokenRows]) -> SparseBev | None:
    """Return the cells of several packets, all of one form, as one set, by key; None of none."""
    if not parts:
        return None
    key = np.concatenate([p.key for p in parts])
    order = np.argsort(key)
    features = torch.from_numpy(_features(parts)).index_select(0, torch.from_numpy(order))
    return SparseBev(features, Sites(torch.from_numpy(key[order]), parts[0].grid))


def _features(parts: list[TokenRows]) -> NDArray[Any]:
    """Return (n, C) float32, or uint8 of codes and of clusters, of the rows of several packets of one form."""
    if parts[0].encoding == "clusters":
        return np.concatenate([join_clustered(p.scales, p.values, p.channels, p.own_bytes) for p in parts])
    dtype, channels = _FEATURE_TYPES[parts[0].encoding], parts[0].channels
    # A copy that may be written to, in the machine's own order of bytes.
    values = np.frombuffer(b"".join(p.values for p in parts), dtype).astype(dtype.newbyteorder("="))
    values = values.reshape(-1, channels)
    if parts[0].encoding == "int8":
        codes = np.frombuffer(b"".join(p.scales for p in parts), np.uint8).reshape(-1, channels)
        return primitives.dequantise_int8(np.repeat(codes, [len(p.key) for p in parts], axis=0), values)
    if parts[0].encoding == "codebook":
        return values
    return torch.from_numpy(values).float().numpy()


def merge_objects(parts: list[NDArray[Any]]) -> Boxes | None:
    """Return the objects of several packets, in that order, with height and z from their labels; None of none."""
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
        score=torch.from_numpy((rows["score"] / np.iinfo(rows["score"].dtype).max).astype(np.float32)),
        label=label,
        id=torch.from_numpy(np.where(ids == 255, -1, ids)),
        sigma_xy=torch.from_numpy(primitives.log_values(rows["sigma_xy"], *_SIGMA_XY)),
        sigma_yaw=torch.from_numpy(primitives.log_values(rows["sigma_yaw"], *_SIGMA_YAW)),
        p_flip=torch.from_numpy((rows["label_flip"] >> 3).astype(np.float32) / 31),
        velocity=torch.from_numpy(_column_or_zeros(rows, "velocity", 2) * np.float32(_METRES_PER_S)),
    )


def merge_descriptors(parts: list[NDArray[Any]]) -> Tensor | None:
    """Return (N, DESCRIPTOR) of the objects of several packets, in that order; None where they have none."""
    if not parts or "descriptor" not in (parts[0].dtype.names or ()):
        return None
    return torch.from_numpy(_column_or_zeros(np.concatenate(parts), "descriptor", DESCRIPTOR_DIM) / np.float32(127))


def _column_or_zeros(rows: NDArray[Any], name: str, width: int) -> NDArray[np.float32]:
    """Return a column of small integers, zeros where the rows have none."""
    present = name in (rows.dtype.names or ())
    return rows[name].astype(np.float32) if present else np.zeros((len(rows), width), np.float32)


def merge_points(parts: list[NDArray[Any]]) -> PointCloud | None:
    """Return the points of several packets in the sender's order, less those lost; None of none."""
    if not parts:
        return None
    # Packet k of K holds points k, k + K, …: sorting by place within the packet restores the order.
    place = np.concatenate([np.arange(len(p)) for p in parts])
    rows = np.concatenate(parts)[np.argsort(place, kind="stable")]
    xyz = torch.from_numpy(rows["xyz"].astype(np.float32) / 100)
    return PointCloud.of(xyz, torch.from_numpy(rows["intensity"].astype(np.float32) / 255))
