# SPDX-License-Identifier: Apache-2.0
"""Encoding of a detector's tokens with its codebook, and decoding of received tokens."""

from __future__ import annotations

from dataclasses import replace

import torch

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import ReceivedMessage, Rejection, token_rejection
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.detector.protocols import BoxDetector, has_tokens, require_tokens


def require_codebook(detector: BoxDetector) -> Codebook:
    """Return the codebook of a detector; ConfigError without one."""
    codebook = require_tokens(detector).codebook
    if codebook is None:
        raise ConfigError(
            "These weights have no codebook, so they cannot send codes: fit one by 'manyeyes fit-codebook'."
        )
    return codebook


def require_clusters(detector: BoxDetector) -> None:
    """Check that a detector sends clusters; ConfigError otherwise."""
    if getattr(detector, "cluster_form", None) is None:
        raise ConfigError("These weights make no clusters of tokens, as those of the fusion ermvp do: use float16.")


def default_token_encoding(detector: BoxDetector) -> TokenEncoding:
    """Return the default token encoding: clusters if the weights make them, codebook if they have one, else float16."""
    if getattr(detector, "cluster_form", None) is not None:
        return "clusters"
    return "codebook" if has_tokens(detector) and detector.codebook is not None else "float16"


def make_token_format(detector: BoxDetector) -> TokenFormat:
    """Return the format of the tokens that a detector can fuse, with its coding tables; a BoxDetector can fuse none."""
    if not has_tokens(detector):
        return TokenFormat(detector.fingerprint, detector.grid, 0)
    codebook = detector.codebook
    tables = None if codebook is None else CodeTables(detector.fingerprint, codebook.frequencies.cpu().numpy())
    peaks = getattr(detector, "token_peaks", None)
    channels = getattr(detector, "packed_channels", detector.token_channels)
    clusters = getattr(detector, "cluster_form", None)
    return TokenFormat(detector.fingerprint, detector.token_grid, channels, tables, peaks, clusters)


def compress_tokens(tokens: SparseBev, detector: BoxDetector) -> SparseBev:
    """Return shared tokens (N, C + PROPOSAL) as the fusion of the weights compresses them before they are sent."""
    compress = getattr(detector, "compress_tokens", None)
    if compress is None:
        return tokens
    with torch.inference_mode():
        return compress(tokens)


def pack_tokens(tokens: SparseBev, detector: BoxDetector) -> SparseBev:
    """Return the columns of shared tokens (N, C + PROPOSAL) that a detector sends: all, but of a bare fusion."""
    pack = getattr(detector, "pack_tokens", None)
    return tokens if pack is None else pack(tokens)


def unpack_tokens(tokens: SparseBev, detector: BoxDetector) -> SparseBev:
    """Return packed tokens as (N, C + PROPOSAL); proposals that were not sent are neutral."""
    unpack = getattr(detector, "unpack_tokens", None)
    return tokens if unpack is None else unpack(tokens)


def has_token_history(detector: BoxDetector) -> bool:
    """Return whether a detector fuses tokens of earlier frames: any but one with a bare fusion."""
    return not getattr(detector, "is_bare", False)


def quantise_tokens(tokens: SparseBev, detector: BoxDetector) -> SparseBev:
    """Token rows (N, C + PROPOSAL) as codebook bytes (N, W) on the same cells."""
    return tokens.with_features(require_codebook(detector).encode(tokens.features))


def encode_tokens(packed: SparseBev, detector: BoxDetector, encoding: TokenEncoding) -> SparseBev:
    """Return packed tokens as rows of an encoding: of bytes for codebook and clusters, as they are otherwise."""
    if encoding == "codebook":
        return quantise_tokens(packed, detector)
    if encoding == "clusters":
        require_clusters(detector)
        return packed.with_features(detector.encode_clusters(packed.features))  # pyright: ignore[reportAttributeAccessIssue]
    return packed


def decode_tokens(
    received: ReceivedMessage, detector: BoxDetector, token_format: TokenFormat
) -> tuple[ReceivedMessage, Rejection | None]:
    """Return the message with tokens decoded to rows of floats; tokens of another format are dropped and rejected."""
    message, codebook = received.message, detector.codebook if has_tokens(detector) else None
    tokens = message.tokens
    if tokens is None:
        return received, None
    if codebook is not None and not tokens.features.is_floating_point() and tokens.features.shape[1] == codebook.width:
        tokens = tokens.with_features(codebook.decode(tokens.features))
    form = token_format.cluster_form
    if (
        form is not None
        and not tokens.features.is_floating_point()
        and tokens.features.shape[1] == 2 * form[0] + form[1]
    ):
        tokens = tokens.with_features(detector.decode_clusters(tokens.features))  # pyright: ignore[reportAttributeAccessIssue]
    is_other_model = message.fingerprint != token_format.fingerprint
    reason = "wrong_model" if is_other_model else token_format.check_tokens(tokens)
    if reason is not None:
        return replace(received, message=replace(message, tokens=None)), token_rejection(message.agent_id, reason)
    return replace(received, message=replace(message, tokens=unpack_tokens(tokens, detector))), None
