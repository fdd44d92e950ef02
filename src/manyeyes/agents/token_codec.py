# SPDX-License-Identifier: Apache-2.0
"""Encoding of a detector's tokens with its codebook, and decoding of received tokens."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import ReceivedMessage, Rejection, token_rejection
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL_DIM


def require_codebook(detector: Detector) -> Codebook:
    """The codebook of a detector; ConfigError without one."""
    if detector.codebook is None:
        raise ConfigError(
            "These weights have no codebook, so they cannot send codes: fit one by 'manyeyes fit-codebook'."
        )
    return detector.codebook


def default_token_encoding(detector: Detector) -> TokenEncoding:
    """The default token encoding: codebook if the weights have one (a tenth of the bytes), else float16."""
    return "float16" if detector.codebook is None else "codebook"


def make_code_tables(detector: Detector) -> CodeTables | None:
    """Entropy coding tables of these weights; None without a codebook."""
    if detector.codebook is None:
        return None
    return CodeTables(detector.fingerprint, detector.codebook.frequencies.numpy())


def make_token_format(detector: Detector, tables: CodeTables | None) -> TokenFormat:
    """The token format of these weights; tables: those of ``make_code_tables``."""
    channels = detector.encoder.out_channels + PROPOSAL_DIM
    return TokenFormat(detector.fingerprint, detector.token_grid, channels, tables)


def encode_tokens(tokens: SparseBev, detector: Detector) -> SparseBev:
    """Token rows (N, C + PROPOSAL) as codebook bytes (N, W) on the same cells."""
    return tokens.with_features(require_codebook(detector).encode(tokens.features))


def decode_tokens(
    received: ReceivedMessage, detector: Detector, token_format: TokenFormat
) -> tuple[ReceivedMessage, Rejection | None]:
    """The message with tokens decoded to rows of floats; tokens of another format are dropped and rejected."""
    message, codebook = received.message, detector.codebook
    tokens = message.tokens
    if tokens is None:
        return received, None
    if codebook is not None and not tokens.features.is_floating_point() and tokens.features.shape[1] == codebook.width:
        tokens = tokens.with_features(codebook.decode(tokens.features))
    is_other_model = message.fingerprint != token_format.fingerprint
    reason = "wrong_model" if is_other_model else token_format.check_tokens(tokens)
    if reason is not None:
        return replace(received, message=replace(message, tokens=None)), token_rejection(message.agent_id, reason)
    return replace(received, message=replace(message, tokens=tokens)), None
