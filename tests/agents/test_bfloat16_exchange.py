# SPDX-License-Identifier: Apache-2.0
"""Agents whose processors multiply bfloat16 and others exchange tokens: weights, fingerprints and tables are the same."""

from __future__ import annotations

import pytest

from manyeyes.agents.agent import Agent
from manyeyes.models import pretrained


@pytest.mark.parametrize("ego_in_bfloat16", (False, True))
def test_agents_with_and_without_bfloat16_fuse_each_others_tokens(drive, ego_in_bfloat16: bool) -> None:
    ego, other = (Agent(pretrained.load(in_bfloat16=kind)) for kind in (ego_in_bfloat16, not ego_in_bfloat16))
    assert ego.perception_cache.detector.fingerprint == other.perception_cache.detector.fingerprint
    mine, theirs = drive().frames()[:2]
    perception = ego.perceive(mine, other.share(theirs))
    assert [r.message.agent_id for r in perception.received] == [theirs.agent_id] and not perception.rejected
    assert perception.received[0].num_tokens > 10
