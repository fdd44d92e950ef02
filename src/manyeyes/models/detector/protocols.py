# SPDX-License-Identifier: Apache-2.0
"""What the agent asks of a detector: boxes from points, and for intermediate fusion tokens."""

from __future__ import annotations

import hashlib
from typing import Protocol, TypeGuard

from torch import Tensor

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, PointCloud, SparseBev
from manyeyes.models.detector.box_head import DecodeConfig, RawBoxes
from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.fusion.token_merge import FusedBev
from manyeyes.models.fusion.transform_tokens import Tokens

FINGERPRINT_BYTES = 8


class BoxDetector(Protocol):
    """A detector of the user's own: points in, boxes out. It runs the strategies that send boxes or points, or nothing.

    A class may derive from it, which gives the defaults, or have the same attributes.

    Attributes:
        grid: range around the agent in which boxes are detected, in its frame.
    """

    grid: BevGrid

    @property
    def detection_range(self) -> BevGrid:
        """Range in which boxes are evaluated; ``grid`` by default."""
        return self.grid

    @property
    def fingerprint(self) -> bytes:
        """8 bytes that name the model in messages; by default a hash of the name of its class and of its ``version``."""
        kind = type(self)
        name = f"{kind.__module__}.{kind.__qualname__} {getattr(self, 'version', '')}"
        return hashlib.blake2b(name.encode(), digest_size=FINGERPRINT_BYTES).digest()

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        """Detect the boxes of a point cloud, in its frame.

        previous: the sweep before, transformed to the same frame; None at the start of a recording.
        """
        ...


class TokenDetector(BoxDetector, Protocol):
    """A detector whose tokens other agents can fuse; ``models.detector.detector.Detector`` is one.

    Tokens are rows (N, token_channels): features, then the PROPOSAL_DIM columns of a proposal (``proposal``).

    Attributes:
        codebook: of the token encoding in codes; None sends numbers.
    """

    codebook: Codebook | None

    @property
    def min_sent_score(self) -> float:
        """Tokens of a lower redundancy-aware score are not sent; 0 by default, which sends all."""
        return 0.0

    @property
    def token_grid(self) -> BevGrid:
        """The grid of the tokens."""
        ...

    @property
    def token_channels(self) -> int:
        """Number of columns of a token."""
        ...

    @property
    def decode_config(self) -> DecodeConfig:
        """Settings by which raw boxes are decoded."""
        ...

    def extract_tokens(self, points: PointCloud, previous: PointCloud | None = None) -> tuple[SparseBev, RawBoxes]:
        """Return tokens (N, token_channels) of a point cloud, and the raw boxes of the same N cells."""
        ...

    def make_tokens(self, features: SparseBev, raw: RawBoxes) -> SparseBev:
        """Concatenate features (N, C) and the proposals of raw to tokens (N, token_channels)."""
        ...

    def score_tokens(self, tokens: SparseBev) -> Tensor:
        """Importance logits (N,) of tokens; under a budget the highest are sent."""
        ...

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> tuple[FusedBev, RawBoxes]:
        """Fuse the tokens of all agents around each ego, to raw boxes too; past: the ego's tokens of earlier frames."""
        ...


def has_tokens(detector: BoxDetector) -> TypeGuard[TokenDetector]:
    """Return whether a detector is a TokenDetector."""
    return callable(getattr(detector, "extract_tokens", None))


def require_tokens(detector: BoxDetector) -> TokenDetector:
    """Return the detector if it is a TokenDetector.

    Raises:
        ConfigError: it detects boxes only.
    """
    if has_tokens(detector):
        return detector
    raise ConfigError(
        f"{type(detector).__name__} is a BoxDetector: it has no tokens, which intermediate fusion and FeaKM send; use the methods "
        "no-fusion, late or early, or a detector with tokens."
    )


def check_detector(detector: BoxDetector) -> None:
    """Check that an object has what a BoxDetector needs.

    Raises:
        ConfigError: it has not; the text names what is missing.
    """
    name, fingerprint = type(detector).__name__, getattr(detector, "fingerprint", None)
    if not callable(getattr(detector, "detect", None)):
        raise ConfigError(f"{name} is no detector: it needs a method detect(points, previous) that returns Boxes.")
    for attribute in ("grid", "detection_range"):
        if not isinstance(getattr(detector, attribute, None), BevGrid):
            raise ConfigError(
                f"{name}.{attribute} needs a BevGrid, the range of its boxes; derive {name} from BoxDetector."
            )
    if not isinstance(fingerprint, bytes) or len(fingerprint) != FINGERPRINT_BYTES:
        raise ConfigError(
            f"{name}.fingerprint needs {FINGERPRINT_BYTES} bytes; derive {name} from BoxDetector for a default."
        )
