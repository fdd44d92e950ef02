# SPDX-License-Identifier: Apache-2.0
"""Between what a detector tells and the bytes of its codebook: the one place where weights and wire meet."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import Reception, Rejection, token_rejection
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.wire import Precision
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.models.detector.codebook import Codebook
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.proposal import PROPOSAL


def codebook_of(detector: Detector) -> Codebook:
    """The codebook, or how to get one."""
    if detector.codebook is None:
        raise ConfigError("These weights have no codebook, so they cannot send codes: fit one by 'manyeyes quantise'.")
    return detector.codebook


def usual_precision(detector: Detector) -> Precision:
    """How tokens are written where nobody says: as codes where the weights can, a tenth of the bytes; else as float16."""
    return "float16" if detector.codebook is None else "codes"


def tables_of(detector: Detector) -> CodeTables | None:
    """The tables by which codes of these weights are sent and read; None where they have no codebook."""
    if detector.codebook is None:
        return None
    return CodeTables(detector.fingerprint, detector.codebook.frequencies.numpy())


def token_format_of(detector: Detector, tables: CodeTables | None) -> TokenFormat:
    """What these weights send and read; tables: those of ``tables_of``."""
    channels = detector.encoder.out_channels + PROPOSAL
    return TokenFormat(detector.fingerprint, detector.token_grid, channels, tables)


def coded(tokens: SparseBev, detector: Detector) -> SparseBev:
    """Told rows (N, C + PROPOSAL) as bytes (N, W) of the codebook, on the same cells."""
    return tokens.with_features(codebook_of(detector).write(tokens.features))


def readable(reception: Reception, detector: Detector, token_format: TokenFormat) -> tuple[Reception, Rejection | None]:
    """The same with codes read, so that tokens are rows of floats again; tokens of another form are left out and rejected."""
    message, book = reception.message, detector.codebook
    tokens = message.tokens
    if tokens is None:
        return reception, None
    if book is not None and not tokens.features.is_floating_point() and tokens.features.shape[1] == book.width:
        tokens = tokens.with_features(book.read(tokens.features))
    others = message.fingerprint != token_format.fingerprint
    reason = "wrong_model" if others else token_format.refusal_of(tokens)
    if reason is not None:
        return replace(reception, message=replace(message, tokens=None)), token_rejection(message.agent_id, reason)
    return replace(reception, message=replace(message, tokens=tokens)), None
