# SPDX-License-Identifier: Apache-2.0
"""Between what a detector tells and the bytes of its codebook: the one place where weights and wire meet."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import Reception
from manyeyes.comms.wire import Precision
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.models.codebook import Codebook
from manyeyes.models.detector import Detector


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


def coded(tokens: SparseBev, detector: Detector) -> SparseBev:
    """Told rows (N, C + PROPOSAL) as bytes (N, W) of the codebook, on the same cells."""
    return tokens.with_features(codebook_of(detector).write(tokens.features))


def readable(reception: Reception, detector: Detector) -> Reception:
    """The same, with codes read: tokens are told rows again. Codes that these weights cannot mean are left out."""
    message, book = reception.message, detector.codebook
    if message.tokens is None or message.tokens.features.is_floating_point():
        return reception
    fits = book is not None and message.tokens.features.shape[1] == book.width
    tokens = message.tokens.with_features(book.read(message.tokens.features)) if book is not None and fits else None
    return replace(reception, message=replace(message, tokens=tokens))
