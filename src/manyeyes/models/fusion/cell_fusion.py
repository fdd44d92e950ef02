# SPDX-License-Identifier: Apache-2.0
"""Fusion by a rule on one feature a sender and cell, in the two modes in which a published method is compared.

inside: the rule replaces the feature merge alone; tokens lie on the cells that they propose, with proposals, velocities, history,
encoding and merged boxes as for every other fusion. It is registered under its name, and absent senders are masked.
bare: features alone are sent; a token stays on the cell where it lies, there is no history, and no velocity but of a method that
compensates delays; boxes come from the single-agent head on the fused features. It is registered as ``NAME/bare``; an absent sender
is a row of zeros, as in the papers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows, gather_by_cell, standing_cells
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens

RuleBuilder = Callable[[int, AttentionConfig, AbsentSenders], nn.Module]
"""Builds a rule of features with that many channels; ``forward(rows: CellRows) -> Tensor`` (U, C) of the cells."""
Rule = TypeVar("Rule", bound=RuleBuilder)


class RuleFusion(nn.Module):
    """Mode inside: the rule fuses encoded features, TokenMerge the boxes."""

    def __init__(self, channels: int, rule: nn.Module) -> None:
        super().__init__()
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "softmax")
        self.rule = rule

    @property
    def compression(self) -> nn.Module | None:
        """What the sender does with its features, if anything (``clusters``)."""
        return getattr(self.rule, "compression", None)

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        features = self.encoding(tokens.features, tokens, place)
        merged = self.merge.merge_proposals(features, tokens, key, place)
        return merged.with_features(self.rule(gather_by_cell(features, tokens, key)[0]))

    def gather(self, tokens: Tokens) -> tuple[CellRows, Tensor]:
        """Return the rows that the rule takes of tokens, and the row (N,) of each token."""
        key, place = assign_cells(tokens)
        return gather_by_cell(self.encoding(tokens.features, tokens, place), tokens, key)


class BareFusion(nn.Module):
    """Mode bare: the rule alone.

    Attributes:
        is_bare: the detector sends features alone, and decodes boxes from the fused features.
        sends_confidence: the rule needs the confidence of the senders; it is one more column of a token.
        sends_velocity: the rule moves delayed rows by velocities of the senders, which are two more columns.
    """

    is_bare = True

    def __init__(self, rule: nn.Module) -> None:
        super().__init__()
        self.rule = rule
        self.sends_confidence, self.sends_velocity = (
            bool(getattr(rule, name, False)) for name in ("sends_confidence", "sends_velocity")
        )

    @property
    def compression(self) -> nn.Module | None:
        """What the sender does with its features, if anything (``clusters``)."""
        return getattr(self.rule, "compression", None)

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature per cell; past is ignored, and merged proposals are zero."""
        rows, _ = self.gather(tokens)
        fused = self.rule(rows)
        return FusedBev(SparseBev(fused, rows.sites), fused.new_zeros(len(rows.sites), PROPOSAL_DIM))

    def gather(self, tokens: Tokens) -> tuple[CellRows, Tensor]:
        """Return the rows that the rule takes of tokens, and the row (N,) of each token."""
        return gather_by_cell(tokens.features, tokens, standing_cells(tokens))


def register_bare(name: str) -> Callable[[Rule], Rule]:
    """Return a decorator that registers a rule in mode bare, as ``name/bare``."""

    def decorate(build: Rule) -> Rule:
        def build_bare(channels: int, attention: AttentionConfig) -> nn.Module:
            return BareFusion(build(channels, attention, "zero"))

        _register(f"{name}/bare", build_bare, build)
        return build

    return decorate


def register_rule(name: str) -> Callable[[Rule], Rule]:
    """Return a decorator that registers a rule in both modes: as ``name``, and as ``name/bare``."""

    def decorate(build: Rule) -> Rule:
        def build_inside(channels: int, attention: AttentionConfig) -> nn.Module:
            return RuleFusion(channels, build(channels, attention, "masked"))

        _register(name, build_inside, build)
        return register_bare(name)(build)

    return decorate


def _register(name: str, build: Callable[[int, AttentionConfig], nn.Module], rule: RuleBuilder) -> None:
    """Register a builder as if it were defined where its rule is, so that the module may be imported again."""
    build.__module__, build.__qualname__ = rule.__module__, f"{getattr(rule, '__qualname__', name)}[{name}]"
    register_fusion(name)(build)
