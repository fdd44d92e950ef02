# SPDX-License-Identifier: Apache-2.0
"""Messages of weights of ERMVP: clusters on the wire, decoded as they were made, within budgets, in both modes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.agents.test_bandwidth import Plane

from manyeyes.agents.agent import Agent
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.token_codec import compress_tokens, default_token_encoding
from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.cluster_rows import decode_cluster_rows, encode_cluster_rows
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


def weights(fusion: str) -> Detector:
    torch.manual_seed(0)
    return Detector(replace(COSTR_TINY, fusion=fusion, prune_threshold=0.05)).eval().requires_grad_(False)


@pytest.mark.parametrize("fusion", ["ermvp", "ermvp/bare"])
@pytest.mark.parametrize("strategy", ["intermediate", "intermediate-ermvp"])
def test_the_receiver_decodes_the_clusters_that_the_sender_made(fusion: str, strategy: str) -> None:
    detector, frames = weights(fusion), Plane().snapshot("plane", 0).frames
    assert default_token_encoding(detector) == "clusters"
    agent = Agent(detector, get_strategy(strategy), budget_bytes=None)
    packets = agent.share(frames[2])
    perception = Agent(detector, get_strategy(strategy)).perceive(frames[0], packets)
    (received,) = perception.received
    assert not perception.rejected
    cache = agent.perception_cache
    tokens = cache.process_tokens(cache.level(frames[2]).levelled).shared_tokens
    made = detector.pack_tokens(compress_tokens(tokens, detector))
    made = agent.token_format.clamp(made.features)
    back = decode_cluster_rows(encode_cluster_rows(made, detector.is_bare), detector.is_bare)
    width = back.shape[1]
    assert torch.equal(received.message.tokens.sites.key, tokens.sites.key)
    assert torch.equal(received.message.tokens.features[:, :width], back)
    numbers = Agent(detector, get_strategy(strategy), "float16", budget_bytes=None).share(frames[2])
    assert sum(map(len, packets)) < 0.55 * sum(map(len, numbers))


def test_a_budget_is_kept_and_spends_its_bytes_on_the_highest_scores() -> None:
    detector, frame = weights("ermvp/bare"), Plane().snapshot("plane", 0).frames[2]
    agent = Agent(detector, get_strategy("intermediate-ermvp"), budget_bytes=None)
    tokens = agent.perception_cache.process_tokens(agent.perception_cache.level(frame).levelled).shared_tokens
    best = int(tokens.sites.key[detector.score_for_sampling(tokens).argmax()])
    sizes = []
    for budget in (0, 100, 400, 1398, 100_000):
        packets = agent.share(frame, budget)
        sizes.append(sum(map(len, packets)))
        assert sizes[-1] <= budget
        received = Agent(detector).perceive(Plane().snapshot("plane", 0).frames[0], packets).received
        keys = received[0].message.tokens.sites.key.tolist() if packets else []
        assert not keys or best in keys
    assert sizes[0] == 0 < sizes[2] < sizes[3] < sizes[4]


def test_other_weights_send_no_clusters() -> None:
    detector = weights("max")
    with pytest.raises(ConfigError, match="ermvp"):
        Agent(detector, token_encoding="clusters")
    frame = Plane().snapshot("plane", 0).frames[1]
    as_usual = Agent(detector, get_strategy("intermediate")).share(frame, 1398)
    assert Agent(detector, get_strategy("intermediate-ermvp")).share(frame, 1398) == as_usual
    with pytest.raises(ConfigError, match="no sampling score"):
        detector.score_for_sampling(Agent(detector).perception_cache.process_tokens(frame).shared_tokens)
