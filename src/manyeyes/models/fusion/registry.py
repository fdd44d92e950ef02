# SPDX-License-Identifier: Apache-2.0
"""Fusion modules by name: ours, and those of third parties (entry points of the group manyeyes.fusion)."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from manyeyes.datatypes.registry import Registry
from manyeyes.models.detector.transformer import AttentionConfig

FusionBuilder = Callable[[int, AttentionConfig], nn.Module]
"""Builds a fusion module of features with that many channels; ``forward(tokens: Tokens, past: Tokens | None) -> FusedBev``."""

_FUSION_MODULES: Registry[FusionBuilder] = Registry("fusion module", "manyeyes.fusion", "manyeyes.models.fusion")

register_fusion = _FUSION_MODULES.register
"""Return a decorator that registers a fusion module, a class or function of (channels, attention), under a name."""
list_fusion_modules = _FUSION_MODULES.names
get_fusion = _FUSION_MODULES.get
